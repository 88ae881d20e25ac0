"""A lot of sensors: one table, its yield by limit, and where its sensors fail."""

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from equipix.batch.evaluation import Row
from equipix.errors import EquipixError
from equipix.io.paths import write_whole
from equipix.report.maps import Map
from equipix.report.page import Part, Table, drawn, mapped, page, write_page
from equipix.shown import Brief

_MOST_TRENDS = 12
"""Most figures that are drawn over the lot."""

_NO_TRENDS = ("components", "sweeps", "order")
"""Figures that say nothing of a sensor."""


@dataclass(frozen=True)
class Lot(Brief):
    """Sensors that were evaluated together.

    Attributes
    ----------
    rows : tuple of Row
        What is known of each sensor.
    """

    rows: tuple[Row, ...]

    def __repr__(self) -> str:
        """How many sensors it has, and how many failed."""
        return f"<Lot: {len(self.rows)} sensors, {len(self.failed)} without a result>"

    @property
    def failed(self) -> tuple[Row, ...]:
        """Sensors without a result."""
        return tuple(row for row in self.rows if row.status == "failed")

    @property
    def yields(self) -> dict[str, tuple[int, int]]:
        """For each figure that is judged: how many sensors pass, of how many that are judged."""
        counts: dict[str, Counter[bool]] = defaultdict(Counter)
        for row in self.rows:
            for check in row.limits:
                if check["verdict"] in ("PASS", "FAIL"):
                    counts[check["figure"]][check["verdict"] == "PASS"] += 1
            if row.verdict:
                counts["all limits"][row.verdict == "PASS"] += 1
        return {name: (count[True], count.total()) for name, count in counts.items()}

    @property
    def columns(self) -> dict[str, list[Any]]:
        """One list for each column of the table; None where a sensor has no such figure."""
        figures = dict.fromkeys(name for row in self.rows for name in row.figures)
        return {
            **{
                name: [getattr(row, name) or None for row in self.rows]
                for name in ("sensor", "status", "verdict", "reason")
            },
            "findings": [", ".join(each["kind"] for each in row.findings) for row in self.rows],
            **{name: [row.figures.get(name) for row in self.rows] for name in figures},
            **{
                name: [getattr(row, name) or None for row in self.rows]
                for name in ("result", "report", "manifest", "key", "seconds", "host")
            },
        }

    def save(self, folder: Path) -> None:
        """Write lot.csv, lot.parquet and lot.html into a folder, each whole or not at all.

        Raises
        ------
        FileError
            If one cannot be written.
        EquipixError
            If pyarrow, jinja2 or matplotlib is not installed.
        """
        columns, text = self.columns, io.StringIO(newline="")
        table = csv.writer(text)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))
        with write_whole(folder / "lot.csv", force=True) as temporary:
            temporary.write_text(text.getvalue(), newline="")
        with write_whole(folder / "lot.parquet", force=True) as temporary:
            _write_parquet(temporary, columns)
        write_page(folder / "lot.html", page([self._part()], folder.resolve().name), force=True)

    def _part(self) -> Part:
        """What the page says."""
        states, verdicts = (
            Counter(getattr(row, name) for row in self.rows) for name in ("status", "verdict")
        )
        counts = [("sensors", str(len(self.rows)))] + [
            (words, str(each))
            for words, each in (
                ("evaluated", states["done"]),
                ("kept, evaluated before", states["kept"]),
                ("without a result", states["failed"]),
                ("PASS", verdicts["PASS"]),
                ("FAIL", verdicts["FAIL"]),
            )
        ]
        return Part(
            name="Lot",
            what=repr(self).strip("<>"),
            findings=(),
            checks=[],
            figures=counts,
            maps=[mapped(each) for each in self._maps()],
            plots=[drawn(partial(_draw, name, values)) for name, values in self._trends()],
            tables=[*self._tables()],
            provenance=[],
        )

    def _tables(self) -> Iterator[Table]:
        """Yield by limit, findings, and the sensors with links to their pages."""
        if self.yields:
            shares = [
                (name.replace("_", " "), f"{100 * good / of:.1f} %", str(good), str(of))
                for name, (good, of) in self.yields.items()
            ]
            yield Table("Yield by limit", ("figure", "yield", "pass", "judged"), shares)
        kinds: dict[str, list[str]] = defaultdict(list)
        for row in self.rows:
            for kind in {each["kind"] for each in row.findings}:
                kinds[kind].append(row.sensor)
        if kinds:
            found = [
                (kind.replace("_", " "), str(len(names)), ", ".join(names))
                for kind, names in sorted(kinds.items(), key=lambda item: -len(item[1]))
            ]
            yield Table("Findings", ("finding", "sensors", "which"), found)
        sensors = [
            (
                row.sensor,
                row.verdict or row.status,
                row.reason or ", ".join(each["kind"] for each in row.findings) or "no finding",
            )
            for row in self.rows
        ]
        links = tuple(row.report for row in self.rows)
        yield Table("Sensors", ("sensor", "verdict", "findings"), sensors, links=links)

    def _maps(self) -> Iterator[Map]:
        """Where pixels are flagged, on average over the sensors of one shape."""
        shapes: dict[str, list[list[list[float]]]] = defaultdict(list)
        for row in self.rows:
            if row.flagged:
                shapes[str(row.figures.get("size", ""))].append(row.flagged)
        for size, shares in shapes.items():
            words = f"Flagged share of pixels, mean of {len(shares)} sensors"
            yield Map(f"{words} of {size}" if size else words, "", np.mean(shares, 0), "size")

    def _trends(self) -> Iterator[tuple[str, list[float | None]]]:
        """Figures that differ between sensors."""
        judged = {check["figure"] for row in self.rows for check in row.limits}
        figures = {
            name: values
            for name, values in self.columns.items()
            if name != "seconds" and name not in _NO_TRENDS and _varies(values)
        }
        names = sorted(figures, key=lambda name: name not in judged)[:_MOST_TRENDS]
        return ((name, figures[name]) for name in names)


def _varies(values: list[Any]) -> bool:
    """Whether these are numbers that differ."""
    known = [value for value in values if value is not None]
    numbers = all(isinstance(value, float) for value in known)
    return numbers and len(set(known)) > 1


def _draw(name: str, values: list[float | None], axes: Any) -> None:
    """Draw a figure of each sensor in the order of the lot."""
    known = [np.nan if value is None else value for value in values]
    axes.plot(range(1, len(known) + 1), known, "o", markersize=3)
    axes.set_xlabel("sensor, in the order of the table")
    axes.set_title(name.replace("_", " "))


def _write_parquet(path: Path, columns: dict[str, list[Any]]) -> None:
    """Write a table of columns."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise EquipixError(
            "lot.parquet needs pyarrow, which is not installed: pip install 'equipix[batch]'"
        ) from error
    parquet.write_table(pa.table(columns), path)
