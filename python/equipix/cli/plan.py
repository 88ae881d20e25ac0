"""The command plan: errors of a pattern of shifts, and better patterns."""

import math
import warnings
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Any

import typer

from equipix._check import Progress
from equipix.cli import terminal
from equipix.errors import EquipixWarning, InputError
from equipix.exposures.positions import whole_moves
from equipix.findings import Finding, Findings, say
from equipix.pictures import check_picture, draw_plans, save_figure
from equipix.plan.budget import ErrorBudget, error_budget
from equipix.plan.components import identify
from equipix.plan.drift import advise_order, distinct_trend
from equipix.plan.search import suggest
from equipix.report.figures import findings_entry

commands = typer.Typer()


@commands.command(
    epilog="Example: equipix plan --shape 582 782 --shifts '0,0 0,11 0,19 11,0 19,0' --drift 1e-4"
    "\n\nTo find a pattern: equipix plan --shape 582 782 --exposures 5 --max-shift 80 80"
)
@terminal.options_of(
    suggest,
    noise="Noise of an exposure relative to its signal.",
    drift="Unknown relative change of the lamp; a tenth of --noise unless given.",
    shift_error="Standard deviation of a shift, in pixels.",
    beam_width="Width D in pixels of a Gaussian beam exp(-r²/D²); unless given the beam is even.",
)
def plan(
    shape: Annotated[tuple[int, int], typer.Option(min=1, help="Rows and columns of the sensor.")],
    shifts: Annotated[
        str | None, typer.Option(help="The pattern to evaluate: 'row,col row,col …' in pixels.")
    ] = None,
    max_shift: Annotated[
        tuple[int, int] | None,
        typer.Option(min=0, help="Find patterns within this travel (row, col), in pixels."),
    ] = None,
    exposures: Annotated[
        int | None,
        typer.Option(min=2, help="Number of exposures of the patterns to find; 5 unless given."),
    ] = None,
    cfa: terminal.Cfa = None,
    rng: terminal.Seed = 0,
    output: terminal.Picture = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
    **causes: Any,
) -> None:
    """Predict the errors of a pattern of shifts, or find better patterns."""
    _refuse_both(shifts, max_shift, exposures)
    said: Findings = ()
    more: list[ErrorBudget] = []
    if causes["shift_error"] and causes["beam_width"] is None:
        words = "--shift-error has no effect in an even beam: give --beam-width for another"
        said = say(Finding("unused", words, "input", "note"))
    check_picture(output)
    terminal.check_output(output, force=force)
    if shifts is not None:
        if causes["drift"] is None:
            causes["drift"] = causes["noise"] / 10
        budgets = [error_budget(shape, _pairs(shifts), **causes)]
    elif max_shift is not None:
        causes |= {"cfa": cfa, "rng": rng}
        with terminal.working() as (progress, _):
            found = suggest(shape, exposures, max_shift, progress=progress, **causes)
            more = _with_more(shape, len(found[0].shifts), max_shift, progress, causes)
        budgets = [suggestion.budget for suggestion in found]
    if output is not None:
        save_figure(draw_plans(budgets), output, force=force)
    budgets = [replace(each, findings=said + each.findings) for each in budgets]
    plans = [_plan_summary(budget, cfa) for budget in budgets]
    if as_json:
        result = {"picture": output and str(output), "shape": list(shape), "patterns": plans}
        if max_shift is not None:
            result["more_exposures"] = [_gain_summary(budget) for budget in more]
        every = dict.fromkeys(each for budget in budgets for each in budget.findings)
        terminal.show_result(result, tuple(every), as_json=True)
    else:
        _show_plans(plans)
        for gain in map(_gain_summary, more):
            words = (
                "with {exposures} positions: {rms:.2e} of all causes, {expected_passes:.0f} passes"
            )
            print(words.format(**gain))  # noqa: T201
        if output is not None:
            terminal.show_result({"picture": str(output)}, as_json=False)


def _refuse_both(
    shifts: str | None, max_shift: tuple[int, int] | None, exposures: int | None
) -> None:
    """Refuse options that ask for an evaluation and for a search, or for neither."""
    if (shifts is None) == (max_shift is None):
        raise InputError(
            "give either --shifts, to evaluate a pattern, or --max-shift, to find patterns"
        )
    if shifts is not None and exposures is not None:
        raise InputError(
            f"--exposures is {exposures}, but a pattern given by --shifts has its own: leave "
            "one out"
        )


def _with_more(
    shape: tuple[int, int],
    count: int,
    max_shift: tuple[int, int],
    progress: Progress | None,
    options: dict[str, Any],
) -> list[ErrorBudget]:
    """Return the budgets of the best patterns of six and seven positions, if that is more.

    Fewer where the travel is too small for a pattern of so many.
    """
    budgets = []
    with warnings.catch_warnings(), suppress(InputError):
        warnings.simplefilter("ignore", EquipixWarning)
        for more in range(max(count + 1, 6), 8):
            found = suggest(shape, more, max_shift, patterns=1, progress=progress, **options)
            budgets.append(found[0].budget)
    return budgets


def _gain_summary(budget: ErrorBudget) -> dict[str, Any]:
    """Collect what a pattern of more positions gives."""
    passes = budget.spectrum.passes
    return {"exposures": len(budget.shifts), "rms": budget.rms, "expected_passes": passes}


def _pairs(text: str) -> list[list[float]]:
    """Parse 'row,col row,col'."""
    try:
        pairs = [[float(part) for part in pair.split(",")] for pair in text.split()]
    except ValueError:
        pairs = []
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise InputError(f"--shifts is {text!r}, expected pairs such as '0,0 0,11 0,19'")
    return pairs


def _plan_summary(budget: ErrorBudget, cfa: str | None) -> dict[str, Any]:
    """Collect the figures of a pattern."""
    # Rounded: equations and unknowns are the same between pixels, and the budget has the parts.
    found = identify(budget.shape, whole_moves(budget.shifts), cfa=cfa)
    order = advise_order(budget.shifts)
    return {
        "shifts": budget.shifts.tolist(),
        "components": budget.components,
        **({} if found.by_colour is None else {"components_by_colour": found.by_colour}),
        "largest": found.largest
        if budget.components == found.components
        else math.prod(budget.shape),
        "equations": found.equations,
        "unknowns": found.unknowns,
        "rms": budget.rms,
        "rms_by_cause": budget.rms_by_cause,
        "tilt_by_cause": {name: list(tilt) for name, tilt in budget.tilt_by_cause.items()},
        "worst_wave": list(budget.spectrum.worst),
        "smallest_eigenvalue": budget.spectrum.smallest,
        "expected_passes": budget.spectrum.passes,
        "distinct_trend": budget.distinct_trend,
        "order": order.tolist(),
        "distinct_trend_in_order": distinct_trend(budget.shifts[order]),
        **findings_entry(budget.findings),
    }


def _show_plans(plans: list[dict[str, Any]]) -> None:
    """Print the patterns' figures side by side."""
    rows = {
        "all causes": lambda p: f"{p['rms']:.2e}",
        "noise": lambda p: f"{p['rms_by_cause']['noise']:.2e}",
        "tilt from lamp drift": lambda p: f"{p['rms_by_cause']['drift']:.2e}",
        "shift errors": lambda p: f"{p['rms_by_cause']['shift_error']:.2e}",
        "parts that nothing compares": lambda p: str(p["components"]),
        "  of each colour alone": lambda p: _by_colour(p["components_by_colour"]),
        "equations / unknowns": lambda p: f"{p['equations']} / {p['unknowns']}",
        "worst wave, cycles per pixel": lambda p: "({:.3f}, {:.3f})".format(*p["worst_wave"]),
        "λ of it": lambda p: f"{p['smallest_eigenvalue']:.3f}",
        "expected passes": lambda p: f"{p['expected_passes']:.0f}",
        "linear trend distinct from tilt": lambda p: f"{p['distinct_trend']:.1%}",
        "  in the order advised": lambda p: f"{p['distinct_trend_in_order']:.1%}",
    }
    if "components_by_colour" not in plans[0]:
        del rows["  of each colour alone"]
    patterns = [f"pattern {k + 1}" for k in range(len(plans))]
    terminal.show_table(
        ("rms error of the sensitivity", *patterns),
        [(name, *map(words, plans)) for name, words in rows.items()],
    )
    for pattern, found in zip(patterns, plans, strict=True):
        shifts = " ".join("{:g},{:g}".format(*found["shifts"][k]) for k in found["order"])
        print(f"{pattern}, in the order advised: {shifts}")  # noqa: T201


def _by_colour(found: dict[str, int]) -> str:
    """Write the components of each colour, and their sum."""
    return f"{sum(found.values())} ({', '.join(f'{k} {n}' for k, n in found.items())})"
