"""A share of each study is run: the same one each time, and never nothing; figures are recorded."""

from __future__ import annotations

import pytest

pytest_plugins = ["pytester"]

SUITE = """
import pytest

@pytest.mark.study
def test_drawn(draws, figure):
    used = draws(20)
    assert used == range(len(used))
    figure("number", len(used), "a share of 20")

@pytest.mark.study
@pytest.mark.parametrize("case", range(30))
def test_cases(case):
    pass

@pytest.mark.study
@pytest.mark.parametrize("case", "ab")
def test_few(case):
    pass

def test_a_law():
    pass
"""


@pytest.fixture
def suite(pytester, request, monkeypatch):
    """A run of a suite with studies in it."""
    pytester.makepyprojecttoml('[tool.pytest.ini_options]\nmarkers = ["study: of many draws"]')
    pytester.makepyfile(test_suite=SUITE)
    monkeypatch.setenv("PYTHONPATH", str(request.path.parent))

    def run(*options):
        return pytester.runpytest_inprocess("-p", "studies", *map(str, options))

    return run


@pytest.mark.parametrize(
    ("share", "drawn", "kept"), [(0.1, 2, 3), (0.2, 4, 6), (1, 20, 30), (1e-9, 1, 1)]
)
def test_a_share_of_draws_and_of_parameter_sets_is_run(suite, pytester, share, drawn, kept):
    few = max(1, int(2 * share))
    suite("--study-share", share, "--study-record", "page.md").assert_outcomes(
        passed=1 + kept + few + 1, deselected=30 - kept + 2 - few
    )
    page = (pytester.path / "page.md").read_text()
    assert f"| `test_suite.py::test_drawn` | {drawn} | number | a share of 20 | {drawn} |" in page
    assert page.count("test_cases") == kept


def test_a_larger_share_holds_a_smaller_one(suite, pytester):
    pages = []
    for share in (0.1, 0.2):
        suite("--study-share", share, "--study-record", "page.md", "-k", "cases")
        pages.append(set((pytester.path / "page.md").read_text().splitlines()[8:]))
    assert pages[0] < pages[1]


@pytest.mark.long
@pytest.mark.usefixtures("suite")
def test_workers_keep_the_same_and_write_the_same_page(pytester):
    pages = []
    for workers in (0, 2):
        options = ("-p", "studies", "--study-record", "page.md", "-n", str(workers))
        done = pytester.runpytest_subprocess(*options)
        done.assert_outcomes(passed=1 + 3 + 1 + 1, deselected=None if workers else 28)
        pages.append((pytester.path / "page.md").read_text())
    assert pages[0] == pages[1]


def test_a_failed_study_is_in_the_record(suite, pytester):
    pytester.makepyfile(
        test_suite="""
import pytest

@pytest.mark.study
def test_wrong(draws, figure):
    figure("z", 1.5, "1")
    assert not draws(1)
"""
    )
    suite("--study-record", "page.md").assert_outcomes(failed=1)
    page = (pytester.path / "page.md").read_text()
    assert "0 passed, 1 failed" in page
    assert "| z | 1 | 1.5 |" in page
    assert "| the test | passed | failed |" in page


def test_what_cannot_be_shared_is_no_study(suite, pytester):
    pytester.makepyfile(test_suite="import pytest\n@pytest.mark.study\ndef test_one(): pass\n")
    suite().stderr.fnmatch_lines(["*test_one: a study has parameters or uses `draws`"])


@pytest.mark.parametrize("share", ["0", "-1", "1.5", "half", "nan"])
def test_a_share_is_above_0_and_at_most_1(suite, share):
    suite("--study-share", share).stderr.fnmatch_lines([f"*invalid share value: '{share}'"])
