"""How training is going: episode figures gathered on the device, and a line for people.

rsl_rl's logger copies rewards and lengths of finished episodes to the host at every environment
step, and each copy waits for the GPU. Here everything is summed on the device and copied once an
iteration.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

LEAST_EPISODES = 100
"""Means are over the last iterations in which at least so many episodes ended."""
_RECENT = 20
"""Iterations that the rate is averaged over."""
_TERMINAL_S = 1.0
"""Least time between two refreshes on a terminal [s]."""
_PLAIN_S = 10.0
"""Least time between two lines elsewhere [s]."""


class Episodes:
    """Returns and lengths of the episodes of N environments, and what they log."""

    def __init__(self, count: int, device: torch.device | str) -> None:
        self.returns = torch.zeros(count, device=device)
        """Sum of rewards of each episode so far. (N,)"""
        self.lengths = torch.zeros(count, device=device)
        """Policy steps of each episode so far. (N,)"""
        self.ended: deque[tuple[float, float, float]] = deque()
        """Of recent iterations: sum of returns, sum of lengths, number of ended episodes."""
        self.non_finite = 0
        """Environments whose physics went wrong, since the run began."""
        self._sums = torch.zeros(4, device=device)
        self._logs: list[tuple[str, Any]] = []

    def step(
        self,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        log: Mapping[str, Any],
        non_finite: torch.Tensor | None = None,
    ) -> None:
        """Take in one environment step; nothing waits for the device.

        Args:
            rewards: (N,).
            dones: Nonzero where the episode ended. (N,)
            log: mjlab's figures of this step, numbers or tensors of one element.
            non_finite: Where physics went wrong, bool. (N,)
        """
        self.returns += rewards
        self.lengths += 1.0
        ended = dones > 0
        done = ended.to(self.returns.dtype)
        wrong = done.new_zeros(()) if non_finite is None else non_finite.sum()
        self._sums += torch.stack(
            [torch.dot(self.returns, done), torch.dot(self.lengths, done), done.sum(), wrong]
        )
        self.returns.masked_fill_(ended, 0.0)
        self.lengths.masked_fill_(ended, 0.0)
        self._logs.extend(log.items())

    def figures(self) -> dict[str, float]:
        """Figures of the iteration that ends here, by the names that TensorBoard shows.

        Mean return and length are missing until an episode has ended.
        """
        returns, lengths, ended, wrong = self._sums.tolist()
        self._sums.zero_()
        self.non_finite += round(wrong)
        self.ended.append((returns, lengths, ended))
        while sum(entry[2] for entry in self.ended) - self.ended[0][2] >= LEAST_EPISODES:
            self.ended.popleft()
        figures = self._logged()
        figures["Train/non_finite"] = float(self.non_finite)
        total = [sum(column) for column in zip(*self.ended, strict=True)]
        if total[2] > 0:
            figures["Train/mean_reward"] = total[0] / total[2]
            figures["Train/mean_episode_length"] = total[1] / total[2]
        return figures

    def _logged(self) -> dict[str, float]:
        """Mean of every figure over the steps that gave it, with one copy from the device."""
        values = [value for _, value in self._logs]
        far = [i for i, value in enumerate(values) if torch.is_tensor(value) and value.is_cuda]
        if far:
            copied = torch.stack([values[i].reshape(()).float() for i in far]).tolist()
            for i, value in zip(far, copied, strict=True):
                values[i] = value
        gathered: dict[str, list[float]] = {}
        for (name, _), value in zip(self._logs, values, strict=True):
            gathered.setdefault(name if "/" in name else f"Episode/{name}", []).append(float(value))
        self._logs.clear()
        return {name: sum(entries) / len(entries) for name, entries in gathered.items()}


class ProgressLine:
    """One line that says how far training has come; rewritten on a terminal, repeated elsewhere.

    Use as a context manager.
    """

    def __init__(self, what: str, *, done: int, total: int, console: Console) -> None:
        """Begin.

        Args:
            what: Name of the phase.
            done: Iterations that are done already.
            total: Iterations in all.
            console: Where to.
        """
        self._what = what
        self._total = total
        self._console = console
        self._last = -float("inf")
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._before = time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        self._bar = Progress(
            *columns,
            TextColumn("{task.fields[words]}"),
            console=console,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(what, total=total, completed=done, words="")

    def __enter__(self) -> ProgressLine:
        """Show the bar."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last line standing."""
        self._bar.refresh()
        self._bar.stop()

    def show(self, done: int, figures: Mapping[str, float], steps: int) -> None:
        """Tell that an iteration is done; prints if it is time to.

        Args:
            done: Iterations done.
            figures: Of this iteration, by TensorBoard's names.
            steps: Environment steps of one iteration.
        """
        now = time.monotonic()
        self._recent.append(now - self._before)
        self._before = now
        least = _TERMINAL_S if self._console.is_terminal else _PLAIN_S
        words = self._words(done, figures, steps)
        self._bar.update(self._task, completed=done, words=words)
        if now - self._last < least and done < self._total:
            return
        self._last = now
        if self._console.is_terminal:
            self._bar.refresh()
        else:
            text = f"{self._what} {done}/{self._total}  {words}"
            self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _words(self, done: int, figures: Mapping[str, float], steps: int) -> str:
        seconds = sum(self._recent) / len(self._recent)
        words = [f"{rate(steps / seconds)} steps/s"]
        if "Train/mean_reward" in figures:
            words.append(f"reward {figures['Train/mean_reward']:.2f}")
            words.append(f"episode {figures['Train/mean_episode_length']:.0f} steps")
        for name, value in figures.items():
            if name.startswith("Curriculum/"):
                words.append(f"{name.removeprefix('Curriculum/')} {value:.3g}")
        if figures.get("Train/non_finite"):
            words.append(f"non-finite {figures['Train/non_finite']:.0f}")
        words.append(f"{duration(seconds * (self._total - done))} left")
        return "  ".join(words)


def rate(per_second: float) -> str:
    """A rate for people: 253 k, 1.25 M."""
    for unit, size in (("M", 1e6), ("k", 1e3), ("", 1.0)):
        if per_second >= 0.9995 * size:
            return f"{per_second / size:.3g} {unit}".rstrip()
    return f"{per_second:.2g}"


def duration(seconds: float) -> str:
    """A duration for people: 48 s, 3 min 20 s, 1 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
