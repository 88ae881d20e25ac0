"""A lot of sensors: one table, its yield by limit, and where its sensors fail."""

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from equipix._check import Array
from equipix.batch.evaluation import Row
from equipix.errors import EquipixError, FileError
from equipix.findings import Finding, Findings, Flag, Severity
from equipix.io.paths import write_whole, writing
from equipix.report.figures import name_of
from equipix.report.maps import Map
from equipix.report.page import Part, Table, drawn, mapped, page, write_page
from equipix.shown import Brief

LOT = "lot"
"""Name of the files of the lot, which no sensor has."""

_MOST_TRENDS = 12
"""Most figures that are drawn over the lot."""

_ANY = str(Flag.DO_NOT_USE.name)

_MOST_NAMED = 10
"""Most sensors that a finding of the lot names."""

_NO_TRENDS = ("components", "sweeps", "order", "sensitivity_mean")
"""Figures that say nothing of a sensor: the mean of M is 1 by definition."""


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
    def findings(self) -> Findings:
        """What limits sensors of the lot, what limits most of them first."""
        names: dict[tuple[str, Severity], list[str]] = defaultdict(list)
        for row in self.rows:
            if row.status == "failed":
                names["no_result", "failure"].append(row.sensor)
            for each in {(each["kind"], each["severity"]) for each in row.findings}:
                names[cast("tuple[str, Severity]", each)].append(row.sensor)
        ordered = sorted(names.items(), key=lambda item: (-len(item[1]), item[0]))
        return tuple(
            Finding(
                kind, f"{len(found)} of {len(self.rows)} sensors: {_some(found)}", "input", severity
            )
            for (kind, severity), found in ordered
        )

    @property
    def columns(self) -> dict[str, list[Any]]:
        """One list for each column of the table; None where a sensor has no such figure."""
        figures = dict.fromkeys(name for row in self.rows for name in row.figures)
        return {
            **{
                name: [getattr(row, name) or None for row in self.rows]
                for name in ("sensor", "status", "verdict", "reason")
            },
            "findings": [", ".join(_kinds(row)) for row in self.rows],
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
        _refuse_no_parquet()
        columns, text = self.columns, io.StringIO(newline="")
        table = csv.writer(text)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))
        with write_whole(folder / f"{LOT}.csv", force=True) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8", newline="")
        with write_whole(folder / f"{LOT}.parquet", force=True) as temporary:
            _write_parquet(temporary, columns)
        report = page([self._part()], folder.resolve().name)
        write_page(folder / f"{LOT}.html", report, force=True)

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
            findings=self.findings,
            checks=[],
            figures=counts,
            maps=[mapped(each) for each in self._maps()],
            plots=[drawn(partial(_draw, name, values)) for name, values in self._trends()],
            tables=[*self._tables()],
            provenance=[],
        )

    def _tables(self) -> Iterator[Table]:
        """Yield by limit, and the sensors with links to their pages."""
        if self.yields:
            shares = [
                (name_of(name), f"{100 * good / of:.1f} %", str(good), str(of))
                for name, (good, of) in self.yields.items()
            ]
            yield Table("Yield by limit", ("figure", "yield", "pass", "judged"), shares)
        sensors = [
            (
                row.sensor,
                row.verdict or row.status,
                row.reason or "; ".join(_against(row)) or "no finding",
            )
            for row in self.rows
        ]
        links = tuple(row.report for row in self.rows)
        yield Table("Sensors", ("sensor", "verdict", "findings"), sensors, links=links)

    def _maps(self) -> Iterator[Map]:
        """Where sensors of one shape have each flag, and where those beyond a limit have any."""
        shapes: dict[str, list[Row]] = defaultdict(list)
        for row in self.rows:
            if "size" in row.figures:
                shapes[row.figures["size"]].append(row)
        for size, rows in shapes.items():
            of = f"of {len(rows)} sensors of {size}"
            for name in dict.fromkeys(name for row in rows for name in row.flagged):
                words = name.lower().replace("_", " ")
                yield Map(f"Share {of} with pixels flagged '{words}' there", "", _where(rows, name))
            limits = dict.fromkeys(name for row in rows for name in _beyond(row))
            for limit in limits:
                failed = [row for row in rows if limit in _beyond(row)]
                if any(_ANY in row.flagged for row in failed):
                    words = f"beyond the limit of {name_of(limit)}"
                    where = _where(failed, _ANY) * (len(failed) / len(rows))
                    yield Map(f"Share {of} {words}, with flagged pixels there", "", where)

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


def _where(rows: list[Row], flag: str) -> Array:
    """Share of sensors that have pixels with a flag in each part."""
    found = [np.array(row.flagged[flag]) > 0 for row in rows if flag in row.flagged]
    return np.asarray(np.sum(found, 0) / len(rows))


def _beyond(row: Row) -> list[str]:
    """Figures beyond their limits."""
    return [each["figure"] for each in row.limits if each["verdict"] == "FAIL"]


def _against(row: Row) -> list[str]:
    """What speaks against a sensor: kinds of findings, and figures beyond their limits."""
    beyond = [f"beyond the limit of {name_of(each)}" for each in _beyond(row)]
    return [each.replace("_", " ") for each in _kinds(row)] + beyond


def _kinds(row: Row) -> list[str]:
    """Kinds of findings, each once: those of colour planes are often alike."""
    return [*dict.fromkeys(each["kind"] for each in row.findings)]


def _some(names: list[str]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


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
    axes.set_title(name_of(name))


def refuse_no_table(folder: Path) -> None:
    """Refuse to begin where the table could not be written in the end."""
    with writing(folder):
        for suffix in (".csv", ".parquet", ".html"):
            if (taken := folder / f"{LOT}{suffix}").is_dir():
                raise FileError(f"{taken}: is a folder, expected a file: name another output")
    _refuse_no_parquet()


def _refuse_no_parquet() -> None:
    try:
        import pyarrow as pa  # noqa: F401
    except ImportError as error:
        raise EquipixError(
            "lot.parquet needs pyarrow, which is not installed: pip install 'equipix[batch]'"
        ) from error


def _write_parquet(path: Path, columns: dict[str, list[Any]]) -> None:
    """Write a table of columns."""
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(columns), path)
