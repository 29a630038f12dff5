"""Budgets and goals as people write them."""

import pytest

from express50.dial.budget import Clock, budget_text, parse_budget, parse_goal
from express50.errors import ConfigError
from express50.runner.executor import Pool
from express50.runner.ledger import Receipt
from express50.runner.runner import run_stage
from tests.faults import toy


@pytest.mark.parametrize(
    ("text", "seconds", "cores"),
    [("90s", 90, False), ("45m", 2700, False), ("45min", 2700, False), ("1h30m", 5400, False),
     ("1.5h", 5400, False), ("2d", 172800, False), ("40ch", 144000, True)],
)  # fmt: skip
def test_budgets_are_read(text, seconds, cores):
    budget = parse_budget(text)
    assert (budget.seconds, budget.cores) == (seconds, cores)


@pytest.mark.parametrize("text", ["", "2", "h", "0h", "2x", "1h2", "-1h", "1h 2m", "1h3ch", "nan"])
def test_text_that_is_not_a_time_is_refused(text):
    with pytest.raises(ConfigError, match="expected a time such as 45m"):
        parse_budget(text)


@pytest.mark.parametrize("cores", [False, True])
@pytest.mark.parametrize("seconds", [0.0, 0.2, 61.3, 121.0, 7000.0, 40000.0])
def test_an_advised_budget_can_be_given_and_is_enough(seconds, cores):
    """What was left of a run that made more items than foreseen was 0s."""
    budget = parse_budget(budget_text(seconds, cores))
    assert budget.cores == cores and seconds <= budget.seconds


def test_goals_are_read():
    assert (parse_goal("0.5mm").value, parse_goal(".004alpha").unit) == (0.5, "alpha")
    for text in ("mm", "0mm", "0.5", "0.5 parsec", "-1mm"):
        with pytest.raises(ConfigError, match=r"such as 0\.5mm"):
            parse_goal(text)


def test_a_clock_counts_sessions_and_closes_before_what_does_not_fit():
    clock = Clock(parse_budget("100ch"), spent=100 * 3600 - 10.0)
    assert not clock.closed()
    receipt = Receipt(stage="s", item="i", fingerprint="f", status="done", core_seconds=4.0)
    clock.settled(receipt)
    assert clock.left() == pytest.approx(6.0)
    clock.expect(item=7.0)
    assert clock.closed()
    clock.expect(item=5.0, early=2.0)  # what comes later needs two
    assert clock.closed()
    clock.expect(item=5.0)
    assert not clock.closed()


def test_workers_begin_no_more_than_the_core_hours_left_pay_for(tmp_path):
    """Processor time is known only at an item's end: both workers began although one item fits."""
    names = ["a", "b", "c", "d"]
    clock = Clock(parse_budget("0.002ch"))  # 7.2 s
    clock.expect(item=4.0)
    with Pool(2) as pool:
        summary = run_stage(
            toy.STAGE, toy.make_dataset(tmp_path, names), toy.ToyConfig(seconds=0.1), pool=pool,
            progress=False, monitor=clock,
        )  # fmt: skip
    assert (summary.count("done"), summary.count("left")) == (1, 3)
