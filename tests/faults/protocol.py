"""A model of how outputs are published, and an explorer that visits every state of it.

It has one item of one stage. Several workers may make it at once: those of a killed run live on for
a while, and a scheduler may take a slow worker for dead. What items share (the lock, the run's
folder, the ledger's transactions) is in the model; all else each has of its own.

`steps` lists what may happen next: a step of a driver or worker, a kill, a power failure, a rename
that a file server carries out late, even after the death of who asked for it. A mistake in `Rules`
changes the protocol, to see that `explore` finds the harm.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

ATTEMPTS = 2
TORN, WRITTEN, FILES_SYNCED, WHOLE = range(4)  # the last two differ after a power failure alone
SET_ASIDE = -1
BAD = "bad"  # settings with which the stage fails

BEFORE_RENAME = ("write", "sync files", "sync entries")
AFTER_RENAME = ("sync parent", "delete aside", "report", "dead")
MISTAKES = (
    "entries not synced",
    "parent not synced",
    "receipt before rename",
    "old removed first",
    "looks before it renames",
    "leftovers deleted in place",
    "former not restored",
    "no lock",
)


@dataclass(frozen=True)
class Rules:
    """How large the model is, whether folders can be swapped, and what is wrong with it."""

    mistake: str = ""
    swaps: bool = True
    workers: int = 3
    crashes: int = 2
    late: int = 1
    runs: int = 3
    at_once: int = 2


class Folder(NamedTuple):
    """A folder of outputs: the settings that it was made with, and how much of it is safe."""

    settings: str
    grade: int


class Run(NamedTuple):
    """A driver: what it does next, and what it found."""

    number: int
    settings: str
    at: str = "lock"
    attempts: int = 0
    stands: bool = False
    result: str = ""


class Make(NamedTuple):
    """A worker that makes the item; ``aside`` and ``former`` are folders in its run's folder.

    ``moved``: the cleaner of a later run has taken these away. ``lost``: nobody waits for it.
    """

    run: int
    settings: str
    at: str = "make aside"
    aside: int | None = None
    former: int | None = None
    moved: bool = False
    lost: bool = False
    failed: bool = False
    found: bool = False


class State(NamedTuple):
    """All that the next step depends on.

    ``target`` is the published folder, ``durable`` what a power failure would leave there; ``open``
    numbers the runs whose folder exists.
    """

    crashes: int
    late: int
    starts: int
    folders: tuple[Folder, ...]
    target: int | None
    durable: int | None
    receipt: str = ""
    kept_receipt: str = ""
    open: tuple[int, ...] = ()
    runs: tuple[Run, ...] = ()
    makes: tuple[Make, ...] = ()


Steps = Iterator[tuple[str, State]]


def first_states(rules: Rules) -> list[State]:
    """Return a dataset without the item, and one where settings "a" have made it."""
    budget = rules.crashes, rules.late, rules.runs
    made = State(*budget, (Folder("a", WHOLE),), 0, 0, receipt="a", kept_receipt="a")
    return [State(*budget, (), None, None), made]


def steps(state: State, rules: Rules) -> Steps:
    """Yield what may happen next, and the state after it."""
    alive = [run for run in state.runs if run.at != "over"]
    if state.starts and len(alive) < rules.at_once:
        number = 1 + max(
            [-1, *(one.number for one in state.runs), *(m.run for m in state.makes), *state.open]
        )
        for settings in ("a", "b", BAD):
            run = Run(number, settings)
            yield "start", state._replace(starts=state.starts - 1, runs=(*state.runs, run))
    for run in alive:
        for name, after in _drive(state, run, rules):
            yield f"driver: {name}", after
    for make in dict.fromkeys(state.makes):
        if make.at != "dead":
            for name, after in _work(state, make, rules):
                yield f"worker: {name}", after
    if state.crashes:
        yield from _crash(state._replace(crashes=state.crashes - 1))


def telling_steps(state: State, rules: Rules) -> Steps:
    """Yield steps of which the order can matter; all others lead to the same states later.

    Nobody can tell when a worker writes, syncs and deletes what is its own, and a run that waits
    before it asks for the lock might as well have started later.
    """
    held = (None, state.target, state.durable)
    for make in state.makes:
        deletes = make.at == "delete aside" and make.aside not in held and make.former is None
        if make.at in BEFORE_RENAME or deletes:
            return ((f"worker: {name}", after) for name, after in _work(state, make, rules))
    for run in state.runs:
        if run.at == "lock":
            return ((f"driver: {name}", after) for name, after in _drive(state, run, rules))
    return steps(state, rules)


def _drive(state: State, run: Run, rules: Rules) -> Steps:
    def go(at: str, after: State = state, **changes: object) -> State:
        return _with_run(after, run, run._replace(at=at, **changes))

    if run.at == "lock":
        holders = [one for one in state.runs if one.at not in ("lock", "over")]
        if holders and rules.mistake != "no lock":
            yield "lock refused", _with_run(state, run, None)
            return
        before = state._replace(runs=tuple(one for one in state.runs if one.at != "over"))
        yield "lock", go("clear", before)
    elif run.at in ("clear", "clear again"):
        last = "over" if run.at == "clear again" else "look"
        yield from _clear(state, run, rules, lambda after: go(last, after))
    elif run.at == "look":
        there = _published(state).settings == state.receipt
        if there and state.receipt == run.settings:
            yield "look", go("over", result="current")
        else:
            for stands in {there, False}:  # an earlier stage may have given the item other data
                yield "look", go("open", stands=stands)
    elif run.at == "open":
        yield "make the run's folder", go("hand", state._replace(open=(*state.open, run.number)))
    elif run.at == "hand":
        if sum(not make.at.startswith("dead") for make in state.makes) < rules.workers:
            after = state._replace(makes=(*state.makes, Make(run.number, run.settings)))
            yield "hand out", go("wait", after, attempts=run.attempts + 1)
    elif run.at == "wait":
        yield from _wait(state, run, go)
    elif run.at == "done":
        after = state._replace(receipt=run.settings)
        yield "commit", go("clear again", after, result="done")
    elif run.at == "failed":
        if run.stands or state.target in (None, SET_ASIDE):
            receipt = state.receipt if run.stands else "failed"
            yield "commit", go("clear again", state._replace(receipt=receipt), result="failed")
        else:
            yield "set aside", go("set aside", state._replace(target=SET_ASIDE))
    elif run.at == "set aside":
        yield "sync parent", go("failed", state._replace(durable=state.target))


def _wait(state: State, run: Run, go: Callable[..., State]) -> Steps:
    own = [one for one in state.makes if one.run == run.number and not one.lost]
    for make in own:
        if make.at == "report":
            after = _with_make(state, make, None if make.aside is None else _dead(make))
            yield "receipt", go("failed" if make.failed else "done", after)
        elif make.at == "publish early":
            after = _with_make(state, make, make._replace(at="rename", lost=True))
            yield "receipt", go("done", after)
    if any(not make.at.startswith("dead") for make in own):
        if run.attempts < ATTEMPTS and state.crashes:  # a scheduler takes them for dead
            makes = tuple(m._replace(lost=m.lost or m.run == run.number) for m in state.makes)
            after = state._replace(makes=makes, crashes=state.crashes - 1)
            yield "worker lost", go("hand", after)
    elif run.attempts < ATTEMPTS:
        yield "worker died", go("hand")
    else:
        yield "worker died", go("failed")


def _clear(state: State, run: Run, rules: Rules, go: Callable[[State], State]) -> Steps:
    """Take away what runs left: first its names, so that nobody can publish it, then its bytes."""
    if rules.mistake == "leftovers deleted in place":
        yield from _clear_in_place(state, go)
        return
    held = [m for m in state.makes if not m.moved and (m.aside, m.former) != (None, None)]
    for make in held:
        yield "take away", _with_make(state, make, make._replace(moved=True))
    for number in state.open:
        if number not in {make.run for make in held}:
            rest = tuple(one for one in state.open if one != number)
            yield "remove the run's folder", state._replace(open=rest)
    if state.open:
        return
    taken = [make for make in state.makes if make.moved]
    former = next((make.former for make in taken if make.former is not None), None)
    if state.target is None and former is not None and rules.mistake != "former not restored":
        yield "restore", state._replace(target=former)
        return
    if taken:
        makes = tuple(
            m._replace(former=None) if m.former == state.target else m for m in state.makes
        )
        yield "sync parent", state._replace(durable=state.target, makes=makes)
    restored = state.target is not None and state.target in [make.former for make in taken]
    if not taken or (state.durable == state.target and not restored):
        after = state
        for make in taken:
            bare = make._replace(aside=None, former=None)
            after = _torn(_with_make(after, make, bare), make.aside, make.former)
        yield "delete", go(after._replace(makes=tuple(m for m in after.makes if _matters(m))))


def _clear_in_place(state: State, go: Callable[[State], State]) -> Steps:
    held = [make for make in state.makes if make.aside is not None]
    for make in held:
        if state.folders[make.aside].grade != TORN:
            yield "delete a file", _torn(state, make.aside)
    if all(state.folders[make.aside].grade == TORN for make in held):
        makes = tuple(make._replace(aside=None, former=None) for make in state.makes)
        yield "delete", go(state._replace(makes=tuple(filter(_matters, makes))))


def _work(state: State, make: Make, rules: Rules) -> Steps:
    def go(at: str, after: State = state, **changes: object) -> State:
        return _with_make(after, make, make._replace(at=at, **changes))

    reachable = make.aside is not None and not make.moved
    if make.at == "make aside":
        if make.run not in state.open:
            yield "fail", go("report", failed=True)
            return
        folders = (*state.folders, Folder(make.settings, TORN))
        yield "make aside", go("write", state._replace(folders=folders), aside=len(state.folders))
    elif make.at == "delete aside":
        after = go("report", aside=None, former=None) if reachable else go("report")
        yield "delete aside", _torn(after, make.aside, make.former) if reachable else after
    elif make.at == "report":
        waits = any(run.number == make.run for run in state.runs if run.at != "over")
        if make.lost or not waits:
            yield "report to nobody", _with_make(state, make, _dead(make))
    elif make.at.endswith("in flight"):
        for name, after in _rename(state, make, rules):
            yield f"late {name}", after
    elif make.at == "sync parent":
        yield "sync parent", go("delete aside", state._replace(durable=state.target))
    elif not reachable or (make.at == "write" and make.settings == BAD):
        yield "fail", go("delete aside", failed=True)
    elif make.at in ("write", "sync files", "sync entries"):
        order = {"write": WRITTEN, "sync files": FILES_SYNCED, "sync entries": WHOLE}
        names = [*order, "publish early" if rules.mistake == "receipt before rename" else "rename"]
        if rules.mistake == "entries not synced":
            names.remove("sync entries")
        following = names[names.index(make.at) + 1]
        yield make.at, go(following, _graded(state, make.aside, order[make.at]))
    elif make.at == "rename" and rules.mistake == "looks before it renames":
        yield "look", go("rename as seen", found=bool(_published(state).settings))
    elif make.at in ("rename", "rename as seen"):
        yield from _rename(state, make, rules)
        if state.late:
            yield "rename is sent", go("in flight", state._replace(late=state.late - 1))


def _rename(state: State, make: Make, rules: Rules) -> Steps:
    """Carry out one rename; a file server may do so after the worker's death."""
    dead = make.at.startswith("dead")

    def go(at: str, after: State = state, **changes: object) -> State:
        changed = make._replace(at="dead" if dead else at, **changes)
        return _with_make(after, make, changed if not dead or _matters(changed) else None)

    there = state.target not in (None, SET_ASIDE)
    following = "delete aside" if rules.mistake == "parent not synced" else "sync parent"
    astray = rules.mistake == "looks before it renames" and make.found != there
    if make.aside is None or make.moved or make.run not in state.open or astray:
        yield "fail", go("delete aside", failed=True)
    elif not there:
        yield "rename", go(following, state._replace(target=make.aside), aside=None)
    elif rules.mistake == "old removed first":
        yield "delete old", go("rename", _torn(state, state.target)._replace(target=None))
    elif rules.swaps:
        yield "swap", go(following, state._replace(target=make.aside), aside=state.target)
    else:
        yield "rename old", go("rename", state._replace(target=None), former=state.target)


def _crash(state: State) -> Steps:
    for run in state.runs:
        if run.at != "over":
            yield "kill driver", _with_run(state, run, None)
    for make in dict.fromkeys(state.makes):
        if not make.at.startswith("dead"):
            dead = _dead(make)
            yield "kill worker", _with_make(state, make, dead if _matters(dead) else None)
    makes = tuple(filter(_matters, (make._replace(at="dead") for make in state.makes)))
    dark = state._replace(runs=(), makes=makes)
    for receipt in {state.receipt, state.kept_receipt}:
        for target in {state.target, state.durable}:
            kept = tuple(_undone(make, state.target, target) for make in makes)
            after = dark._replace(receipt=receipt, kept_receipt=receipt, makes=kept)
            after = after._replace(target=target, durable=target)
            yield "power fails", after
            if target not in (None, SET_ASIDE) and state.folders[target].grade < WHOLE:
                yield "power fails", _graded(after, target, TORN)


def _undone(make: Make, target: int | None, after: int | None) -> Make:
    """Return what is beside the target where a power failure has undone renames of it."""
    if after is not None and make.former == after:
        return make._replace(former=None)
    return make._replace(aside=target) if after is not None and make.aside == after else make


def _dead(make: Make) -> Make:
    return make._replace(at="dead in flight" if make.at == "in flight" else "dead")


def _matters(make: Make) -> bool:
    """Return whether a worker lives or left something."""
    left = make.aside is not None or make.former is not None
    return left or make.at not in ("dead", "dead in flight")


def _with_run(state: State, run: Run, after: Run | None) -> State:
    kept = (after if one == run else one for one in state.runs)
    return state._replace(runs=tuple(one for one in kept if one is not None))


def _with_make(state: State, make: Make, after: Make | None) -> State:
    makes = list(state.makes)
    place = makes.index(make)
    makes[place : place + 1] = [] if after is None else [after]
    return state._replace(makes=tuple(makes))


def _graded(state: State, folder: int, grade: int) -> State:
    folders = list(state.folders)
    folders[folder] = folders[folder]._replace(grade=grade)
    return state._replace(folders=tuple(folders))


def _torn(state: State, *folders: int | None) -> State:
    for folder in folders:
        if folder is not None and folder != SET_ASIDE:
            state = _graded(state, folder, TORN)
    return state


def _published(state: State) -> Folder:
    return Folder("", TORN) if state.target in (None, SET_ASIDE) else state.folders[state.target]


def harm(state: State, before: State) -> str:
    """Say what is wrong with a state; empty where nothing is."""
    content = _published(state)
    kept = any(make.former is not None for make in state.makes)
    if content.settings and content.grade == TORN:
        return "torn"
    if state.target is None and before.durable is not None and not kept:
        return "lost"
    if state.target is None and state.receipt in ("a", "b") and not kept:
        return "lost"
    if sum(run.at not in ("lock", "over") for run in state.runs) > 1:
        return "doubled"
    waited = {run.number for run in state.runs if run.at == "wait"}
    failed = (make for make in state.makes if make.failed and make.run in waited)
    if any(make.settings != BAD and not make.lost for make in failed):
        return "failed in vain"
    for run in state.runs:
        right = content.settings == state.receipt == run.settings
        if run.at == "over" and run.result != "failed" and not right:
            return "lost"
    return ""


def canonical(state: State) -> State:
    """Return the state as which it counts: what makes no difference any more is left out.

    Folders, runs and workers come in one order. Nothing needs to be durable if no crash can come. A
    folder that nobody can publish any more counts as torn. A worker whose folder was taken away
    can only fail, and nobody waits for it.
    """
    if not state.crashes:
        state = state._replace(durable=state.target, kept_receipt=state.receipt)
    held, folders = (state.target, state.durable), list(state.folders)
    waiting = {run.number for run in state.runs if run.at in ("hand", "wait")}
    makes = []
    for make in state.makes:
        lost = make.lost or make.run not in waiting
        homeless = make.at == "make aside" and make.run not in state.open
        if make.moved or (lost and (homeless or make.at == "report")):
            make = _dead(make)._replace(at="dead")
        if make.at in AFTER_RENAME and make.aside is not None and make.aside not in held:
            folders[make.aside] = Folder("", TORN)
        if make.at == "dead":
            make = Make(-1 if make.moved else make.run, "", "dead", *make[3:6], lost=True)
        elif make.at in AFTER_RENAME:
            failed = make.failed and not lost
            settings = make.settings if failed else ""
            make = make._replace(settings=settings, lost=lost, failed=failed)
        if _matters(make):
            makes.append(make._replace(lost=lost))
    makes.sort(key=lambda m: (*m[:3], *m[5:], *(held.index(f) if f in held else 9 for f in m[3:5])))
    numbers = {*state.open, *(run.number for run in state.runs), *(make.run for make in makes)}
    run_of = {number: at for at, number in enumerate(sorted(numbers - {-1}))} | {-1: -1}
    new: dict[int | None, int | None] = {None: None, SET_ASIDE: SET_ASIDE}
    for folder in (*held, *(one for make in makes for one in make[3:5])):
        new.setdefault(folder, len(new) - 2)
    return state._replace(
        folders=tuple(folders[folder] for folder in list(new)[2:]),
        target=new[state.target],
        durable=new[state.durable],
        open=tuple(sorted(run_of[number] for number in state.open)),
        runs=tuple(sorted(_at_most(run)._replace(number=run_of[run.number]) for run in state.runs)),
        makes=tuple(
            m._replace(run=run_of[m.run], aside=new[m.aside], former=new[m.former]) for m in makes
        ),
    )


def _at_most(run: Run) -> Run:
    """Return a driver without what it no longer needs."""
    if run.at in ("hand", "wait"):
        return run
    return run._replace(attempts=0, stands=run.stands and run.at in ("open", "failed"))


def explore(rules: Rules) -> tuple[int, str, list[str]]:
    """Visit every state; returns their number, and the first harm with the steps that led to it.

    A state that was visited with as many crashes, late renames and runs to come, or more of them,
    leads to nothing new.
    """
    came: dict[State, tuple[State, str] | None] = dict.fromkeys(first_states(rules))
    waiting, left = deque(came), {state[3:]: [state[:3]] for state in came}
    while waiting:
        state = waiting.popleft()
        for name, raw in telling_steps(state, rules):
            after = canonical(raw)
            budgets = left.setdefault(after[3:], [])
            if any(a >= after[0] and b >= after[1] and c >= after[2] for a, b, c in budgets):
                continue
            budgets.append(after[:3])
            came[after] = state, name
            if wrong := harm(after, state):
                return len(came), wrong, _way(came, after)
            waiting.append(after)
    return len(came), "", []


def _way(came: dict[State, tuple[State, str] | None], state: State) -> list[str]:
    names = []
    while (step := came[state]) is not None:
        state, name = step
        names.append(name)
    return names[::-1]
