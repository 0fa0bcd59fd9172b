"""The layer that takes the jump input, made so that widening is exact.

A network that gets a new input with zero weights should give what it gave before. Zeros alone do
not make that true bit for bit: a matrix product with a column more is summed in another order
(seen on CPU with batches of 1, 2 and 7; any GPU kernel may). `JumpLinear` therefore does the old
product as it was and adds the jump part to it.
"""

from __future__ import annotations

from rsl_rl.modules import MLP
from torch import Tensor, nn

JUMP_WEIGHT = "jump_weight"
"""Name of the new weights, the last part of their name in a network's state."""


class JumpLinear(nn.Linear):
    """A linear layer whose last inputs have weights of their own, `jump_weight`.

    y = (x[:in] weight^T + bias) + x[in:] jump_weight^T. With a zero `jump_weight` y is, bit for
    bit, what `nn.Linear` gives for x[:in]: the same product of the same operands, plus zero.
    """

    def __init__(self, whole: nn.Linear, jump_size: int) -> None:
        """Split a layer.

        Args:
            whole: Layer over all inputs; its values are taken over.
            jump_size: How many of its last inputs are the jump's.
        """
        super().__init__(whole.in_features - jump_size, whole.out_features)
        weight, jump_weight = whole.weight.detach().tensor_split([self.in_features], dim=1)
        self.weight = nn.Parameter(weight.clone())
        self.bias = nn.Parameter(whole.bias.detach().clone())
        self.jump_weight = nn.Parameter(jump_weight.clone())

    def forward(self, x: Tensor) -> Tensor:
        """(..., in + jump) to (..., out)."""
        # A view with gaps between its rows may be multiplied by another kernel: hence contiguous.
        old = x[..., : self.in_features].contiguous()
        new = x[..., self.in_features :]
        return super().forward(old) + nn.functional.linear(new, self.jump_weight)


def split_jump_inputs(mlp: MLP, jump_size: int) -> None:
    """Give the last `jump_size` inputs of a network weights of their own; 0 leaves it alone."""
    if jump_size:
        mlp[0] = JumpLinear(mlp[0], jump_size)
