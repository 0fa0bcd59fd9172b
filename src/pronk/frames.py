"""Data frames of pandas, an optional package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pronk.errors import PronkError

if TYPE_CHECKING:
    from pandas import DataFrame


def data_frame(columns: Mapping[str, Sequence[Any] | Any]) -> DataFrame:
    """Make a data frame.

    Args:
        columns: Values of each column, all of one length, by its name, which ends with the unit.

    Returns:
        The data frame, with its rows numbered from 0.

    Raises:
        PronkError: pandas is not installed.
    """
    try:
        import pandas  # an optional package
    except ImportError:
        raise PronkError(
            "to_dataframe() needs pandas, which is not installed; install it with "
            "`pip install 'pronk[pandas]'`."
        ) from None
    return pandas.DataFrame(dict(columns))
