"""Draw what imports what: the rooms of the package, its floors and its arrows.

    python docs/architecture_graph.py  # writes docs/architecture.svg, prints the counts

A room is a module, or a package of modules, directly below `autocost_jax`. Its floor is
the longest way down; an arrow is an import between two rooms. Needs the extra `dev`.
"""

import sys
from pathlib import Path

import grimp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PACKAGE = "autocost_jax"
OUT = Path(__file__).parent / "architecture.svg"


def read_rooms() -> dict[str, set[str]]:
    """Each room and the rooms that it imports."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)

    def room(module: str) -> str:
        return module.split(".")[1]

    inside = [module for module in graph.modules if module != PACKAGE]
    rooms: dict[str, set[str]] = {room(module): set() for module in inside}
    for module in inside:
        for other in graph.find_modules_directly_imported_by(module):
            if other != PACKAGE and room(other) != room(module):
                rooms[room(module)].add(room(other))
    return rooms


def floors_of(rooms: dict[str, set[str]]) -> dict[str, int]:
    """The floor of each room, 0 for those that import nothing of the package."""
    floors: dict[str, int] = {}

    def climb(name: str, above: tuple[str, ...] = ()) -> int:
        if name in above:
            raise ValueError(f"{name} imports itself, by way of {above[-1]}")
        if name not in floors:
            below = [climb(other, (*above, name)) for other in rooms[name]]
            floors[name] = 1 + max(below, default=-1)
        return floors[name]

    for name in rooms:
        climb(name)
    return floors


def draw(rooms: dict[str, set[str]], floors: dict[str, int], path: Path) -> None:
    """Rooms as boxes, floor above floor; an arrow points at what is imported."""
    top = max(floors.values())
    fig, axes = plt.subplots(figsize=(9, 0.75 * (top + 1)))
    place = {}
    for floor in range(top + 1):
        names = sorted(name for name in rooms if floors[name] == floor)
        for i, name in enumerate(names):
            shift = 0.35 * (-1) ** floor  # else arrows would hide behind boxes
            place[name] = ((i + 1) / (len(names) + 1) * 10 + shift, floor)
    for name, others in sorted(rooms.items()):
        for other in sorted(others):
            (x, y), (to_x, to_y) = place[name], place[other]
            axes.annotate(
                "", (to_x, to_y + 0.22), (x, y - 0.22),
                arrowprops={"arrowstyle": "->", "color": "0.65", "lw": 0.6},
            )  # fmt: skip
    for name, (x, y) in place.items():
        box = {"boxstyle": "round,pad=0.35", "facecolor": "#dfe8f5", "edgecolor": "0.4"}
        axes.text(x, y, name, ha="center", va="center", fontsize=9, bbox=box)
    axes.set(xlim=(0, 10.5), ylim=(-0.5, top + 0.5))
    axes.axis("off")
    fig.tight_layout()
    fig.savefig(path, metadata={"Date": None})


def main() -> None:
    """Draw and count."""
    matplotlib.rcParams["svg.hashsalt"] = PACKAGE  # the same file every time
    rooms = read_rooms()
    floors = floors_of(rooms)
    draw(rooms, floors, Path(sys.argv[1]) if len(sys.argv) > 1 else OUT)
    arrows = sum(len(others) for others in rooms.values())
    print(f"{len(rooms)} rooms, {1 + max(floors.values())} floors, {arrows} arrows")


if __name__ == "__main__":
    main()
