"""`equipix plan` for a sensor of 150 megapixels: seconds and memory, for `make bench`."""

from __future__ import annotations

from commands import Row, measure

SHAPE = (10240, 14648)
CROSS = "0,0 0,11 0,19 11,0 19,0"


def rows(shape: tuple[int, int] = SHAPE, travel: int = 200) -> list[Row]:
    """Measure each command in a process of its own, and give the table's rows."""
    plan = ("plan", "--shape", *map(str, shape))
    searched = measure((*plan, "--max-shift", str(travel), str(travel)))
    judged = measure((*plan, "--shifts", CROSS))
    found = f"plan --max-shift {travel} {travel}, {shape[1]}×{shape[0]}"
    given = f"plan of cross (11, 19), {shape[1]}×{shape[0]}"
    return [
        (f"{work}: {name}", f"<= {limit:g} {unit}", f"{got:.{places}f} {unit}", how)
        for work, limit, cost in ((found, 15.0, searched), (given, 2.0, judged))
        for name, limit, unit, got, places, how in (
            (
                "time of the processor",
                limit,
                "s",
                cost.processors,
                1,
                "user and system, with imports",
            ),
            ("peak memory", 0.3, "GB", cost.gigabytes, 2, "of the process"),
        )
    ]


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
