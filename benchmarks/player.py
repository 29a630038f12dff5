"""Measure the browser player: ``python -m benchmarks.player CHECKPOINT SHARDS [--subject ID]``.

Exports a trained person as an HTML page and plays it in headless Chromium without a GPU: 512 px,
its tour of expressions with jaw and gaze moving. ``loss_db`` compares the page's arrays with the
full model on footage of cameras and expressions that training did not see (of all, where it saw
all). The last line is one JSON object; without Chromium ``frames_per_second`` is ``n/a``.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from websockets.sync.client import ClientConnection, connect

from benchmarks.common import make_parser
from grmm.checkpoint import load_checkpoint
from grmm.edit import trained_head
from grmm.player import export_player
from grmm.shard_source import ShardSource

PICTURE_PX = 512
PLAYER = Path(__file__).resolve().parents[1] / "grmm" / "player"
SHARED = (".html", ".css", ".js")  # the player's files that every page holds
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


class Page:
    """A page in headless Chromium, spoken to by its DevTools protocol."""

    def __init__(self, socket: ClientConnection, process: int) -> None:
        """Speak through an open socket to the browser with this process id."""
        self.socket, self.number, self.process = socket, 0, psutil.Process(process)

    def ask(self, method: str, **parameters: object) -> dict[str, Any]:
        """Send one command and return its result; a RuntimeError if the page refuses it."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            reply = json.loads(self.socket.recv(timeout=60))
            if reply.get("id") == self.number:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']}")
                return dict(reply["result"])

    def value(self, script: str) -> Any:
        """Return what an expression is worth in the page, promises awaited."""
        options = {"returnByValue": True, "awaitPromise": True}
        result = self.ask("Runtime.evaluate", expression=script, **options)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait(self, script: str, seconds: float = 30.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.value(script):
            if time.monotonic() > end:
                raise TimeoutError(f"{script} did not come true in {seconds:g} s")
            time.sleep(0.05)

    def core_seconds(self) -> float:
        """Return what all processes of the browser have spent on cores."""
        family = [self.process, *self.process.children(recursive=True)]
        return float(sum(sum(one.cpu_times()[:2]) for one in family))

    def picture(self) -> bytes:
        """Return a screenshot, PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])


@contextmanager
def chromium(address: str, width: int, height: int) -> Iterator[Page]:
    """Open an address in headless Chromium without a GPU.

    Raises:
        FileNotFoundError: there is no Chromium.
    """
    program = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    if program is None:
        raise FileNotFoundError("chromium is not installed")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            program, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            f"--user-data-dir={profile}", "--remote-debugging-port=0",
            f"--window-size={width},{height}", "about:blank",
        ]  # fmt: skip
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            port = _port(Path(profile) / "DevToolsActivePort")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as reply:
                tabs = json.load(reply)
            target = next(tab for tab in tabs if tab["type"] == "page")["webSocketDebuggerUrl"]
            with connect(target, max_size=None, compression=None) as socket:
                page = Page(socket, process.pid)
                size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
                page.ask("Emulation.setDeviceMetricsOverride", **size)
                page.ask("Page.navigate", url=address)
                page.wait("document.readyState === 'complete'")
                yield page
        finally:
            process.terminate()
            process.wait(timeout=30)


def _port(file: Path, seconds: float = 60.0) -> int:
    """Wait for the browser to write the port that it listens on."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if file.exists() and (lines := file.read_text().split()):
            return int(lines[0])
        time.sleep(0.1)
    raise TimeoutError(f"chromium did not open a port in {seconds:g} s")


def speed(page: Page, seconds: float = 8.0) -> dict[str, float]:
    """Press Play and count the pictures that are shown, after three seconds that do not count.

    Other work on the machine lowers the rate; the browser's time on cores hardly depends on it.
    """
    page.value("press('play')")
    time.sleep(3)
    script = "[performance.now() / 1000, Number(canvas.dataset.pictures)]"
    spent, (began, before) = page.core_seconds(), page.value(script)
    time.sleep(seconds)
    (ended, after), spent = page.value(script), page.core_seconds() - spent
    return {
        "frames_per_second": round((after - before) / (ended - began), 1),
        "core_milliseconds_per_frame": round(1e3 * spent / (after - before), 1),
    }


def main() -> None:
    """Export, play, print."""
    parser = make_parser("player", __doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("shards", type=Path)
    parser.add_argument("--subject", help="default: the first")
    args = parser.parse_args()
    loaded = load_checkpoint(args.checkpoint)
    subject = args.subject or loaded.model.subjects[0]
    expressions = loaded.model.expressions
    expression = "neutral" if "neutral" in expressions else expressions[0]
    head = trained_head(loaded, subject, expression)
    figures: dict[str, object] = {"benchmark": "player", "size": PICTURE_PX}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "player.html"
        views = loaded.views(ShardSource(args.shards, "*"))
        report = export_player(path, loaded, head, subject, views)
        shared = sum(file.stat().st_size for file in PLAYER.iterdir() if file.suffix in SHARED)
        figures |= {
            "gaussians": report.gaussians,
            "megabytes_per_person": round(report.megabytes - shared / 1e6, 2),
            "megabytes_shared": round(shared / 1e6, 3),
            "agreement_db": round(report.agreement_db, 2),
            "full_db": report.full_db and round(report.full_db, 2),
            "loss_db": "n/a" if report.loss_db is None else round(report.loss_db, 3),
            "footage": report.footage,
            "images": report.images,
        }
        try:
            with chromium(f"file://{path}#size={PICTURE_PX}", 900, 600) as page:
                page.wait("canvas.dataset.pictures > 0")
                figures["cores"] = page.value("navigator.hardwareConcurrency")
                figures |= speed(page)
        except FileNotFoundError as error:
            figures |= {"frames_per_second": "n/a", "reason": str(error)}
    figures["load_before"] = round(os.getloadavg()[0], 2)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
