import json
import re
import shutil
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from collections import Counter
from itertools import product

import numpy as np
import pytest
import tifffile

from express50.errors import CaptureError, ConfigError, FormatError
from express50.files.images import write_image
from grmm.cli import main
from grmm.study import (
    PAGE,
    StudyPages,
    append_answer,
    check_answer,
    make_server,
    make_study,
    markdown,
    method_of,
    read_answers,
    read_study,
    summarise,
    trials,
)


@pytest.fixture
def folders(tmp_path):
    """Three folders of 7 pictures named alike; one has an extra."""
    made = {}
    for number, name in enumerate(("reference", "ours", "theirs")):
        made[name] = tmp_path / name
        made[name].mkdir()
        for example in range(7 + (name == "ours")):
            pixels = np.full((8, 8, 3), 20 * example + number, np.uint8)
            write_image(made[name] / f"S{example:03d}_smile_cam01.png", pixels)
    return made


def made_in(out, folders):
    methods = (("Ours", folders["ours"]), ("MD", folders["theirs"]))
    return make_study(out, folders["reference"], methods, examples=6, participants=4)


@pytest.fixture
def study(folders, tmp_path):
    return tmp_path / "s", made_in(tmp_path / "s", folders)


def test_sides_are_counterbalanced_over_examples_and_participants(study):
    _, made = study
    for participant in range(4):
        sides = Counter(method_of(made, participant, e, "A") for e in range(6))
        assert sides == {"Ours": 3, "MD": 3}
    for example in range(6):
        for side in "AB":
            shown = {method_of(made, p, example, side) for p in (0, 1)}
            assert shown == {"Ours", "MD"}
    orders = [tuple(t["example"] for t in trials(made, p)) for p in range(4)]
    assert len(set(orders)) > 1 and all(sorted(order) == list(range(6)) for order in orders)


def test_what_a_participant_sees_names_no_method(study):
    folder, made = study
    seen = json.dumps(trials(made, 0))
    assert not any(word in seen for word in ("Ours", "MD", "smile", "theirs"))
    for trial in trials(made, 0):
        for side in ("reference", "A", "B"):
            assert (folder / trial[side]).is_file()


def test_the_same_seed_makes_the_same_study(study, folders, tmp_path):
    assert made_in(tmp_path / "t", folders) == study[1]


def answer_all(folder, made, choose):
    people, examples = range(made["participants"]), range(len(made["examples"]))
    for participant, example, question in product(people, examples, made["questions"]):
        ours = "A" if method_of(made, participant, example, "A") == "Ours" else "B"
        answer = choose(participant, example, question, ours)
        ids = {"participant": participant, "example": example, "question": question}
        append_answer(folder, ids | {"answer": answer})


def test_table_turns_sides_back_into_methods(study):
    folder, made = study

    def choose(participant, example, question, ours):
        other = "B" if ours == "A" else "A"
        if question == "identity":
            return f"{ours}++"
        return [f"{ours}+", f"{other}++", "="][example % 3]

    answer_all(folder, made, choose)
    summary = summarise(made, read_answers(folder, made))
    rows = summary["rows"]
    assert rows["identity"]["first++"] == 100 and rows["identity"]["first_interval"] == [100, 100]
    expression = rows["expression"]
    shares = [expression[name] for name in ("first+", "second++", "tie")]
    assert shares == pytest.approx([33.3333] * 3)
    assert rows["overall"]["first"] == pytest.approx(66.6667)
    assert summary["judgments"] == summary["judgments_expected"] == 48
    text = markdown(summary)
    assert "| Identity | 100.0% | 0.0% | 0.0% | 0.0% | 0.0% |" in text and "MD ++" in text


def test_shares_are_rounded_once(study):
    """4 of 21 were shown as 19.1 %: 19.05 rounded again."""
    answers = [
        {"participant": p, "example": e, "question": "identity", "answer": "=" if p < 2 else "A+"}
        for p, e in [*product((0, 1), (0, 1)), *product((2, 3), range(6))]
    ]
    answers += [answers[-1] | {"question": "expression", "example": e} for e in range(5)]
    assert len(answers) == 21 and "| 19.0% |" in markdown(summarise(study[1], answers))


def test_intervals_widen_where_participants_disagree(study):
    folder, made = study
    answer_all(folder, made, lambda p, e, q, ours: f"{ours}+" if p < 2 else "=")
    row = summarise(made, read_answers(folder, made))["rows"]["overall"]
    low, high = row["first_interval"]
    assert row["first"] == 50 and low < 10 and high > 90
    one = [a for a in read_answers(folder, made) if a["participant"] == 0]
    assert summarise(made, one)["rows"]["overall"]["first_interval"] is None


def test_the_last_answer_counts_and_a_torn_line_does_not(study):
    folder, made = study
    answer = {"participant": 1, "example": 2, "question": "identity", "answer": "A+"}
    append_answer(folder, answer)
    append_answer(folder, answer | {"answer": "="})
    with (folder / "answers.jsonl").open("a") as file:
        file.write('{"participant": 1, "exa')
    assert [a["answer"] for a in read_answers(folder, made)] == ["="]
    append_answer(folder, answer | {"example": 3})
    assert [a["example"] for a in read_answers(folder, made)] == [2, 3]
    (folder / "answers.jsonl").write_text('{"a": 1}\nno\n')
    with pytest.raises(FormatError, match="line 1"):
        read_answers(folder, made)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"participant": 4}, "participant is 4, expected 0 to 3"),
        ({"participant": True}, "participant is True"),
        ({"example": -1}, "example is -1"),
        ({"question": "hair"}, "question is 'hair'"),
        ({"answer": "C"}, "answer is 'C'"),
    ],
)
def test_wrong_answers_are_named(study, change, message):
    answer = {"participant": 0, "example": 0, "question": "identity", "answer": "="}
    assert check_answer(study[1], answer | {"more": 1}) == answer
    with pytest.raises(FormatError, match=message):
        check_answer(study[1], answer | change)


def test_page_shows_trials_and_takes_answers_and_nothing_else(study):
    folder, made = study
    with make_server(folder, port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        root = server.address

        def get(path):
            with urllib.request.urlopen(root + path, timeout=5) as reply:
                return reply.read()

        def post(body, kind="application/json"):
            request = urllib.request.Request(root + "answers", body, {"Content-Type": kind})
            with urllib.request.urlopen(request, timeout=5) as reply:
                return reply.status

        try:
            assert b"<title>" in get("")
            content = json.loads(get("trials?participant=1"))
            assert content["trials"] == trials(made, 1) and content["done"] == []
            assert get(content["trials"][0]["A"]).startswith(b"\x89PNG")
            answer = {"participant": 1, "example": 2, "question": "identity", "answer": "A++"}
            assert post(json.dumps(answer).encode()) == 200
            assert json.loads(get("trials?participant=1"))["done"] == [answer]
            for path in ("study.json", "pictures/../study.json", "answers.jsonl"):
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    get(path)
            for number in ("9", "9" * 5000):  # Python refuses to convert the latter
                with pytest.raises(urllib.error.HTTPError, match="400"):
                    get(f"trials?participant={number}")
            for body, kind in ((b"{}", "application/json"), (b"x" * 9999, "application/json")):
                with pytest.raises(urllib.error.HTTPError, match="400"):
                    post(body, kind)
            with pytest.raises(urllib.error.HTTPError, match="415"):
                post(json.dumps(answer).encode(), "text/plain")
        finally:
            server.shutdown()
            thread.join()
    assert read_answers(folder, made) == [answer]


def test_two_people_with_one_number_do_not_overwrite_each_other(study):
    """The later answers replaced the earlier ones unnoticed."""
    folder, made = study
    pages = StudyPages(folder)

    def begin(session, more=""):
        return pages.get(f"trials?participant=1&session={session}{more}")

    def give(answer, session, pages=pages):
        answer = {"participant": 1, "example": 0, "question": "identity", "answer": answer}
        body = json.dumps(answer | {"session": session}).encode()
        return pages.post("answers", "application/json", lambda limit: body).status

    assert begin("a").status == 200 and begin("b").status == 409
    assert give("A+", "a") == 200 and give("B+", "b") == 409
    assert b"as number 1 and given 1 answer. Continue only" in begin("b").body
    assert [answer["answer"] for answer in read_answers(folder, made)] == ["A+"]
    pages = StudyPages(folder)  # the server was stopped and started
    assert begin("b").status == 409 and begin("b", "&continue=yes").status == 200
    assert json.loads(begin("b").body)["done"] == read_answers(folder, made)
    assert give("=", "a", pages) == 409 and give("=", "b", pages) == 200


SHOWN = """<script>
setTimeout(() => { find("participant").value = 1; find("start").requestSubmit(); }, 200);
setTimeout(() => {
  document.title = "widths " + ["reference", "A", "B"].map(name => find(name).naturalWidth);
}, 4000);
</script>"""


def test_a_participant_sees_the_pictures(study, tmp_path, monkeypatch):
    """The page asked for them without the address's token, and got none."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("chromium is not installed")
    page = tmp_path / "page.html"
    page.write_text(PAGE.read_text() + SHOWN)
    monkeypatch.setattr("grmm.study.PAGE", page)
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}",
        "--timeout=8000", "--virtual-time-budget=8000", "--dump-dom",
    ]  # fmt: skip
    with make_server(study[0], port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            command.append(server.address)
            found = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
        finally:
            server.shutdown()
            thread.join()
    widths = re.search(r"<title>widths (\d+),(\d+),(\d+)</title>", found.stdout)
    assert widths and all(int(width) > 0 for width in widths.groups()), found.stdout[:500]


TWICE = """
const elements = {}, posts = [], script = SCRIPT, study = STUDY;
const make = () => ({hidden: false, value: "", elements: {}, append() {}, replaceChildren() {}});
globalThis.document = {getElementById: id => elements[id] ??= make(), createElement: make};
globalThis.fetch = async (url, options) => {
  if (options) posts.push(JSON.parse(options.body));
  await new Promise(done => setTimeout(done, 5));
  return {ok: true, json: async () => options ? {} : study};
};
(0, eval)(script);
const event = {preventDefault() {}};
document.getElementById("participant").value = "1";
elements.start.onsubmit(event).then(async () => {
  elements.trial.elements = {expression: {value: "A+"}, identity: {value: "="}};
  await Promise.all([elements.trial.onsubmit(event), elements.trial.onsubmit(event)]);
  const once = elements.title.textContent;
  await elements.trial.onsubmit(event);
  console.log(JSON.stringify({once, then: elements.title.textContent, posts}));
});
"""


def test_a_double_click_does_not_skip_an_example(study):
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    made = study[1]
    script = PAGE.read_text().split("<script>")[1].split("</script>")[0]
    shown = {"trials": trials(made, 1)[:3], "questions": made["questions"], "done": []}
    code = TWICE.replace("SCRIPT", json.dumps(script)).replace("STUDY", json.dumps(shown))
    run = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    found = json.loads(run.stdout)
    assert (found["once"], found["then"]) == ("2 to go", "1 to go")
    wanted = [trial["example"] for trial in shown["trials"][:2] for _ in made["questions"]]
    assert [answer["example"] for answer in found["posts"]] == wanted


TAKEN = """
const elements = {}, urls = [], script = SCRIPT;
const make = () => ({hidden: false, value: "", elements: {}, append() {}, replaceChildren() {}});
globalThis.document = {getElementById: id => elements[id] ??= make(), createElement: make};
globalThis.confirm = words => words === "taken" && urls.length > 1;
globalThis.fetch = async url => {
  urls.push(url.replace(/session=[^&]+/, "session"));
  const taken = !url.includes("continue");
  return {ok: !taken, status: taken ? 409 : 200, text: async () => "taken\\n",
          json: async () => ({trials: [], done: [], questions: {}})};
};
(0, eval)(script);
const event = {preventDefault() {}};
document.getElementById("participant").value = "1";
elements.start.onsubmit(event).then(async () => {
  const cancelled = [elements.error.textContent, elements.start.hidden];
  await elements.start.onsubmit(event);
  console.log(JSON.stringify({cancelled, urls, begun: elements.start.hidden}));
});
"""


def test_the_page_asks_whoever_enters_a_used_number():
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    script = PAGE.read_text().split("<script>")[1].split("</script>")[0]
    code = TAKEN.replace("SCRIPT", json.dumps(script))
    run = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    found, url = json.loads(run.stdout), "trials?participant=1&session"
    assert found["cancelled"] == ["taken", False] and found["begun"]
    assert found["urls"] == [url, url, f"{url}&continue=yes"]


@pytest.mark.parametrize(
    "change", [{"methods": ["Ours"]}, {"seed": "0"}, {"examples": [{}]}, {"examples": [1]}]
)
def test_a_damaged_study_is_refused(study, change):
    folder, made = study
    (folder / "study.json").write_text(json.dumps(made | change))
    with pytest.raises(FormatError, match="study make"):
        read_study(folder)


def test_commands_make_and_table(folders, tmp_path, capsys):
    out = str(tmp_path / "c")
    make = ["study", "make", out, f"--reference={folders['reference']}"]
    make += [f"--ours={folders['ours']}", f"--theirs={folders['theirs']}", "--examples=5"]
    assert main([*make, "--participants=2", "--names", "GRMM", "MD"]) == 0
    assert main(["study", "table", out]) == 0
    assert "0 of 20 judgments" in capsys.readouterr().out
    append_answer(
        tmp_path / "c", {"participant": 0, "example": 0, "question": "identity", "answer": "="}
    )
    assert main(["study", "table", out]) == 0
    assert "1 of 20 judgments by 1 participant; " in capsys.readouterr().out
    assert main([*make, "--names", "GRMM", "MD"]) == 2
    assert "already has answers" in capsys.readouterr().err


def test_a_study_that_is_served_is_not_made_anew(study, folders, monkeypatch, capsys):
    """Answers counted for the sides of the newer study."""
    folder, _ = study
    make = ["study", "make", str(folder), f"--reference={folders['reference']}", "--examples=6"]
    make += [f"--ours={folders['ours']}", f"--theirs={folders['theirs']}", "--seed=1"]
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    serve = ["study", "serve", str(folder), f"--port={port}"]
    before, codes = read_study(folder), []

    def meanwhile(server):
        codes.extend(map(main, (make, serve)))

    monkeypatch.setattr("express50.local_server.PageServer.serve_forever", meanwhile)
    assert main(serve) == 0
    assert codes == [2, 2] and read_study(folder) == before
    assert capsys.readouterr().err.count("another process writes into this folder") == 2
    assert main(make) == 0 and read_study(folder) != before
    assert main(["study", "serve", str(folder / "study.json")]) == 2
    assert "is a file, expected a folder" in capsys.readouterr().err


def test_an_answer_that_cannot_be_written_is_said_where_the_server_runs(study, capsys):
    folder, _ = study
    answer = {"participant": 1, "example": 2, "question": "identity", "answer": "A++"}
    with make_server(folder, port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        (folder / "answers.jsonl").mkdir()
        body, kind = json.dumps(answer).encode(), {"Content-Type": "application/json"}
        request = urllib.request.Request(f"{server.address}answers", body, kind)
        try:
            with pytest.raises(OSError, match="closed connection"):
                urllib.request.urlopen(request, timeout=5)
        finally:
            server.shutdown()
            thread.join()
    assert "a request failed: IsADirectoryError: " in capsys.readouterr().err


def test_a_picture_that_is_not_finite_is_named(folders, tmp_path):
    image = np.full((8, 8, 3), np.nan, np.float32)
    tifffile.imwrite(tmp_path / "x.tif", image, photometric="rgb")
    for path in folders["ours"].iterdir():  # their content decides, not their name
        shutil.copy(tmp_path / "x.tif", path)
    with pytest.raises(CaptureError, match=r"_cam01.png: image holds NaN .*; export it again"):
        made_in(tmp_path / "out", folders)


def test_too_few_common_pictures_are_refused(folders, tmp_path):
    methods = (("a", folders["ours"]), ("b", folders["theirs"]))
    with pytest.raises(ConfigError, match="7 pictures"):
        make_study(tmp_path / "x", folders["reference"], methods, examples=8)
    with pytest.raises(ConfigError, match="no such folder"):
        make_study(tmp_path / "x", tmp_path / "absent", methods)
