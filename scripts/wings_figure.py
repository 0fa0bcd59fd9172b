"""Draw docs/wings.svg: the three wings of pronk, and the files in which they meet.

python scripts/wings_figure.py
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from pronk.report import style

OUT = Path(__file__).resolve().parents[1] / "docs" / "wings.svg"
WING_COLOURS = {"identify": "#dbeaf4", "jump": "#fbe8d3", "deploy": "#dcefe4"}
STEPS = {
    "identify": ["robot", "sweep", "log (*.mcap)", "response", "match"],
    "jump": ["train", "virtual robot", "trial"],
    "deploy": ["safety filter", "link", "robot"],
}
"""What happens in each wing, in order."""
TOP = {"identify": 4.0, "jump": 2.35, "deploy": 0.7}
"""Middle of each wing, from below."""
FILES = {"gains.yaml": ("identify", "jump"), "policy.onnx": ("jump", "deploy")}
STEP_WIDTH = 1.55
STEP_DISTANCE = 1.95
ARROW = {"arrowstyle": "-|>", "color": "#444444", "linewidth": 1.2}


def draw_wing(axes: Axes, wing: str) -> None:
    """Draw the box of a wing and the steps in it."""
    middle = TOP[wing]
    frame = FancyBboxPatch(
        (0.0, middle - 0.55),
        10.2,
        1.1,
        boxstyle="round,pad=0.05",
        facecolor=WING_COLOURS[wing],
        edgecolor="none",
    )
    axes.add_patch(frame)
    axes.text(0.1, middle + 0.32, f"pronk.{wing}", fontsize=10, fontweight="bold", color="#333333")
    for number, step in enumerate(STEPS[wing]):
        left = 0.25 + number * STEP_DISTANCE
        box = FancyBboxPatch(
            (left, middle - 0.4),
            STEP_WIDTH,
            0.5,
            boxstyle="round,pad=0.03",
            facecolor="white",
            edgecolor="#777777",
        )
        axes.add_patch(box)
        axes.text(left + STEP_WIDTH / 2.0, middle - 0.15, step, ha="center", va="center")
        if number > 0:
            begin = left - STEP_DISTANCE + STEP_WIDTH + 0.05
            axes.annotate(
                "", (left - 0.05, middle - 0.15), (begin, middle - 0.15), arrowprops=ARROW
            )


def main() -> None:
    """Draw the figure."""
    with style.drawing(height=4.6) as (figure, grid):
        axes = grid[0, 0]
        axes.set(xlim=(-0.1, 10.4), ylim=(0.0, 4.75))
        axes.axis("off")
        for wing in STEPS:
            draw_wing(axes, wing)
        for name, (upper, lower) in FILES.items():
            axes.annotate("", (9.0, TOP[lower] + 0.62), (9.0, TOP[upper] - 0.62), arrowprops=ARROW)
            height = (TOP[upper] + TOP[lower]) / 2.0
            axes.text(8.85, height, name, ha="right", va="center", family="monospace")
        style.save_figure(figure, OUT)


if __name__ == "__main__":
    main()
