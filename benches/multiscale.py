"""The fast solver on the hard case beside plain sweeps, for the table of `make bench`."""

from __future__ import annotations

from typing import Any

import cargo
from commands import Row

SMALL = 320 * 240
"""Pixels up to which a sweep runs in cache, and more of them may pass."""


def rows(*, smoke: bool) -> list[Row]:
    """Measure by benches/multiscale.rs, and give the table's rows: work, wanted, got, how."""
    runs = cargo.bench("multiscale", smoke=smoke)
    rows = [row for run in runs for row in (products_row(run), time_row(run), share_row(run))]
    rows += [spread_row(runs, precision) for precision in ("float64", "float32")]
    return rows + [descent_row(run) for run in runs if run["descent"]]


def products_row(run: dict[str, Any]) -> Row:
    """How many products it takes to a certified 1e-6."""
    certified = "converged" if run["converged"] else "not converged"
    return (
        f"{case(run)} to a certified 1e-6: products in all, true error",
        "<= 75, < 1e-6",
        f"{products_in_all(run):.1f}, {run['error']:.1e}, {certified}",
        f"{run['products']} products of {run['product_s'] * 1e3:.2f} ms, {run['steps']} times "
        f"assembly in {run['assemble_s'] * 1e3:.2f} ms, factorisation in "
        f"{run['factorise_s'] * 1e3:.2f} ms; estimate {run['estimate']:.1e}",
    )


def time_row(run: dict[str, Any]) -> Row:
    """How many plain sweeps would pass meanwhile."""
    wanted = 150 if run["rows"] * run["cols"] <= SMALL else 100
    return (
        f"{case(run)} to a certified 1e-6: time",
        f"<= {wanted} sweeps",
        f"{run['calibrate_s'] / run['sweep_s']:.0f} sweeps",
        f"{run['calibrate_s'] * 1e3:.1f} ms, of which the solver {run['solve_s'] * 1e3:.1f} ms; "
        f"sweep {run['sweep_s'] * 1e3:.2f} ms",
    )


def share_row(run: dict[str, Any]) -> Row:
    """How much longer the solver takes than its products alone."""
    of_products = run["products"] * run["product_s"]
    return (
        f"{case(run)} to a certified 1e-6: time of the solver over that of its products",
        "<= 1.5 x",
        f"{run['solve_s'] / of_products:.1f} x",
        f"{run['solve_s'] * 1e3:.1f} ms, {run['products']} products in {of_products * 1e3:.1f} ms",
    )


def spread_row(runs: list[dict[str, Any]], precision: str) -> Row:
    """Whether the products depend on the size."""
    counts = [products_in_all(run) for run in runs if run["precision"] == precision]
    return (
        f"hard case, {precision}: products in all, most over fewest of {len(counts)} sizes",
        "<= 1.2",
        f"{max(counts) / min(counts):.2f}",
        f"{min(counts):.1f} to {max(counts):.1f}",
    )


def descent_row(run: dict[str, Any]) -> Row:
    """How much longer coordinate descent takes to a hundred times the error."""
    sweeps, seconds = run["descent"]
    return (
        f"{case(run)} to 1e-6, against coordinate descent to a true 1e-4",
        ">= 100 x",
        f"{seconds / run['calibrate_s']:.0f} x",
        f"{sweeps} sweeps in {seconds:.1f} s, {run['calibrate_s'] * 1e3:.1f} ms",
    )


def products_in_all(run: dict[str, Any]) -> float:
    """Assembly and factorisation count as their time over one product's."""
    setup: float = run["steps"] * run["assemble_s"] + run["factorise_s"]
    return float(run["products"] + setup / run["product_s"])


def case(run: dict[str, Any]) -> str:
    """Name the data."""
    return f"hard case {run['cols']}×{run['rows']}×5 {run['precision']}"


if __name__ == "__main__":
    for row in rows(smoke=False):
        print(" | ".join(row))
