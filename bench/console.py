"""The console before a long route, in a real Chromium: what it takes to paint, and script at ten updates a second.

python -m bench.console writes docs/results/console.md.
"""

import json
import shutil
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.link import JSON, Link
from bench.measurement import RESULTS, Command, Limit, breaches, limit_table, machine, print_page
from bench.serving import mapped_service
from bench.worlds import N_LANDMARKS, NCLT_IMAGES

_N_BEFORE, _N_WARM_UP, _N_UPDATES, _EVERY_S = 2000, 20, 150, 0.1  # as many events as the page keeps are there already
_FIRST_PAINT_S, _SCRIPT_MS = 1.5, 16.0
_N_OPENED = 5


def lines() -> Iterator[str]:
    """The page, as it is measured."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - of the tools

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium is installed: apt-get install chromium")
    yield from ("# The console before a long route", "", "Made by `python -m bench.console`.", "", machine(), "")
    yield f"A domain of {NCLT_IMAGES:,} map images and a session on it; Chromium without a graphics card, 1440 x 900."
    yield "The service, the robot and the browser share the machine's cores: paints are by the wall, updates are"
    yield "processor time of the page's own thread. As many steps as the page keeps (2,000) were there before."
    yield ""
    turn = np.arange(NCLT_IMAGES) / 4000
    plane = {"x_m": 400 * np.cos(turn) + 60 * np.cos(9 * turn), "y_m": 400 * np.sin(turn) + 60 * np.sin(9 * turn)}
    with mapped_service(**plane) as server, Link(server.url) as link, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--disable-gpu"], chromium_sandbox=False)
        session_id = link.ask("POST", "/v1/domains/bench/sessions", {})["session_id"]
        robot = _Robot(server.url, session_id)
        for _ in range(_N_BEFORE):
            robot.sees()
        url = f"{server.url}/console"
        limits = []
        for name, fragment, text in (
            ("the domain", "#domains/bench", "Map versions"),
            ("a session", f"#sessions/{session_id}", f"After {_N_BEFORE} views"),
        ):
            painted, drawn = zip(*(_opening_s(browser, url + fragment, text) for _ in range(_N_OPENED)), strict=True)
            limits.append(Limit(f"{name}: first contentful paint, s", float(np.median(painted)), _FIRST_PAINT_S))
            limits.append(Limit(f"{name}: all drawn, s", float(np.median(drawn)), _FIRST_PAINT_S))
        limits += _update_limits(browser, f"{url}#sessions/{session_id}", robot)
        browser.close()
    yield from limit_table(limits)
    if (missed := breaches(limits)) is not None:
        yield from ("", missed)


def _opening_s(browser: Any, url: str, text: str) -> tuple[float, float]:
    """Seconds to the first contentful paint, and to the text that comes last."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    start_s = time.perf_counter()
    page.goto(url)
    page.get_by_text(text).first.wait_for()
    drawn_s = time.perf_counter() - start_s
    painted = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    painted_s = page.evaluate(painted) / 1000
    page.context.close()
    return painted_s, drawn_s


class _Robot:
    """A robot that moves a metre a view, and sees another place in each."""

    def __init__(self, url: str, session_id: str) -> None:
        self._url, self._path = url, f"/v1/sessions/{session_id}/observations?action_m=1"
        self._rng = np.random.default_rng(1)

    def sees(self) -> None:
        """Send one view."""
        body = json.dumps({"ranked_landmarks": self._rng.permutation(N_LANDMARKS).tolist()}).encode()
        with Link(self._url) as link:
            link.ask("POST", self._path, body, {"Content-Type": JSON})


def _update_limits(browser: Any, url: str, robot: _Robot) -> list[Limit]:
    """Limits of what updates cost the page, from a robot that sends ten views a second."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    page.goto(url)
    page.get_by_text(f"After {_N_BEFORE} views").first.wait_for()
    browser.start_tracing(page=page, categories=["toplevel", "devtools.timeline"])
    inspector = page.context.new_cdp_session(page)
    inspector.send("Performance.enable", {"timeDomain": "threadTicks"})
    metrics: list[dict[str, float]] = []
    for update in range(-_N_WARM_UP, _N_UPDATES):
        if update == 0:
            metrics.append(_spent(inspector))
        due = time.perf_counter() + _EVERY_S
        robot.sees()
        page.wait_for_timeout(max(0.0, 1000 * (due - time.perf_counter())))
    page.get_by_text(f"After {_N_BEFORE + _N_WARM_UP + _N_UPDATES} views").first.wait_for()
    metrics.append(_spent(inspector))
    spent = {name: 1000 * (metrics[1][name] - metrics[0][name]) / _N_UPDATES for name in metrics[0]}
    longest_ms = _longest_task_ms(json.loads(browser.stop_tracing())["traceEvents"])
    page.context.close()
    return [
        Limit("script an update, ms", spent["ScriptDuration"], _SCRIPT_MS),
        Limit("script, style and layout an update, ms", sum(spent.values()), _SCRIPT_MS),
        Limit("longest task, ms", longest_ms, 100.0),
    ]


def _longest_task_ms(events: list[dict[str, Any]]) -> float:
    """Processor time of the longest task of the thread that runs the console's scripts, which paints it too."""
    page_threads = {
        (e["pid"], e["tid"]) for e in events if e["name"] == "FunctionCall" and "/console/" in json.dumps(e)
    }
    tasks = [e for e in events if e["name"].endswith("RunTask") and (e["pid"], e["tid"]) in page_threads]
    return float(max(e.get("tdur", 0) for e in tasks) / 1000)


def _spent(inspector: Any) -> dict[str, float]:
    """Seconds that the page has spent, by kind."""
    kinds = ("ScriptDuration", "LayoutDuration", "RecalcStyleDuration")
    metrics = inspector.send("Performance.getMetrics")["metrics"]
    return {metric["name"]: metric["value"] for metric in metrics if metric["name"] in kinds}


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "console.md"))
