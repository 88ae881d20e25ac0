"""Reports in a real browser: Debian's chromium, driven by playwright."""

from __future__ import annotations

import os
import re
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from report_results import SHAPE, calibration, every_kind

from equipix.report.limits import limits_template, read_limits
from equipix.report.maps import Map
from equipix.report.page import mapped, page, part_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

WIDE, PHONE = (1200, 900), (360, 740)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """A page with a part of each kind of result, judged by the usual limits."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "limits.toml").write_text(limits_template())
    limits = read_limits(folder / "limits.toml")
    results = every_kind()
    parts = [part_of(name, each, limits, share=len(results)) for name, each in results.items()]
    (folder / "report.html").write_text(page(parts, "All kinds"), encoding="utf-8")
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser():
    """Chromium; without it the tests skip, in CI they fail."""
    if CHROMIUM is None:
        reason = "no chromium: apt-get install chromium"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        # Without its sandbox it also runs for root, as in a container.
        opened = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@contextmanager
def shown(browser, address, size, scheme="light"):
    """Show the page in a window; it writes nothing to the console and asks for nothing else."""
    width, height = size
    viewport = {"width": width, "height": height}
    context = browser.new_context(viewport=viewport, color_scheme=scheme)
    tab = context.new_page()
    told, asked = [], []
    tab.on("console", lambda message: told.append(message.text))
    tab.on("pageerror", lambda error: told.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(address)
    yield tab
    assert told == []
    assert [each for each in asked if not each.startswith("data:")] == [address]
    context.close()


@pytest.mark.long
@pytest.mark.parametrize("size", [WIDE, PHONE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(browser, address, size, scheme):
    from axe_playwright_python.sync_playwright import Axe

    with shown(browser, address, size, scheme) as tab:
        violations = Axe().run(tab).response["violations"]
        serious = [each for each in violations if each["impact"] in ("serious", "critical")]
        assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []


def test_a_phone_does_not_scroll_sideways(browser, address):
    with shown(browser, address, PHONE) as tab:
        assert tab.evaluate("document.documentElement.scrollWidth") == PHONE[0]


@pytest.mark.long
def test_a_map_tells_the_value_under_the_pointer(browser, address):
    sensitivity = calibration().sensitivity
    with shown(browser, address, WIDE) as tab:
        map_, told = tab.locator(".map").first, tab.locator("output").first
        box = map_.bounding_box()
        height, width = (
            box[name] / size for name, size in zip(("height", "width"), SHAPE, strict=True)
        )
        for row, col in ((5, 7), (5, 8), (23, 31)):
            map_.hover(position={"x": (col + 0.5) * width, "y": (row + 0.5) * height})
            words, value = told.inner_text().split(": ")
            assert words == f"row {row}, column {col}"
            # A step of the words of 16 bits, and five digits.
            assert float(value) == pytest.approx(sensitivity[row, col], rel=1e-4, abs=2e-5)


def test_arrow_keys_move_over_a_map(browser, address):
    with shown(browser, address, WIDE) as tab:
        map_, told = tab.locator(".map").first, tab.locator("output").first
        map_.focus()
        places = []
        for key in ("ArrowRight", "ArrowDown", "Shift+ArrowLeft"):
            tab.keyboard.press(key)
            found = re.match(r"row (\d+), column (\d+):", told.inner_text())
            places.append(tuple(map(int, found.groups())))
        (row, col), *others = places
        assert others == [(row + 1, col), (row + 1, col - 10)]


@pytest.mark.long
def test_reduced_maps_tell_the_pixels_of_a_block(browser, tmp_path):
    """Those of the last row and column are fewer."""
    values = np.arange(5.0 * 7).reshape(5, 7)
    part = part_of("cal", calibration(), read_limits(None))
    part = part._replace(maps=[mapped(Map("it", "DN", values), 4)])
    (tmp_path / "it.html").write_text(page([part], "One"), encoding="utf-8")
    with shown(browser, (tmp_path / "it.html").as_uri(), WIDE) as tab:
        box = (map_ := tab.locator(".map").first).bounding_box()
        told = tab.locator("output").first
        for row, col, words in (
            (1, 0, "rows 2 to 3, columns 0 to 1: 18.000 DN"),
            (2, 3, "rows 4 to 4, columns 6 to 6: 34.000 DN"),
        ):
            x, y = (col + 0.5) / 4 * box["width"], (row + 0.5) / 3 * box["height"]
            map_.hover(position={"x": x, "y": y})
            assert told.inner_text() == words


@pytest.mark.long
def test_print_opens_what_is_closed(browser, address):
    with shown(browser, address, WIDE) as tab:
        tab.evaluate("document.querySelectorAll('details').forEach((each) => each.open = false)")
        tab.pdf()
        assert tab.locator("details:not([open])").count() == 0


def test_print_shows_ink_on_paper(browser, address):
    with shown(browser, address, WIDE, "dark") as tab:
        colour = "getComputedStyle(document.body).backgroundColor"
        assert tab.evaluate(colour) == "rgb(22, 22, 22)"
        tab.emulate_media(media="print")
        assert tab.evaluate(colour) == "rgb(255, 255, 255)"
        assert not tab.locator("nav").is_visible()
