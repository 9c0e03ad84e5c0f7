"""The console as people use it: every page, a robot that drives, a remap, a lost connection, a refused key."""

import shutil
import threading
from importlib import resources
from pathlib import Path

import httpx2
import numpy as np
import pytest

from deepsimbad.cli import run as deepsimbad
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope
from deepsimbad_client import Client
from deepsimbad_client.commands import run as deepsimbad_client
from tests.client.conftest import serving

from .conftest import N_FRAMES, make_domain

pytestmark = pytest.mark.slow
PHONE, DESK = {"width": 390, "height": 844}, {"width": 1440, "height": 900}
TOO_WIDE = """document.documentElement.scrollWidth <= innerWidth ? [] : [...document.querySelectorAll("body *")]
    .filter((part) => part.getBoundingClientRect().right > innerWidth).map((part) => part.outerHTML.slice(0, 80))"""
PAGES = {
    "": "Domains",
    "domains/route": "How surely a place is recognised",
    "domains/route/upload": "A recorded drive",
    "sessions": "Sessions",
    "try/route": "Drop an image of the route here",
    "jobs": "succeeded",
    "report": "Reports",
    "no/such/page": "There is no such page",
    "%": "There is no such page",
}


DROPPED = """([name, type, bytes]) => {
    const carried = new DataTransfer();
    carried.items.add(new File([new Uint8Array(bytes)], name, { type }));
    return carried;
}"""


def drop(page, path, kind):
    """Drop a file on the page's heading, outside every drop area."""
    carried = page.evaluate_handle(DROPPED, [path.name, kind, list(path.read_bytes())])
    for event in ("dragover", "drop"):
        page.dispatch_event("h1", event, {"dataTransfer": carried})


def drive(client, session, drive, frames):
    for frame in frames:
        session.observe(image=drive / f"{frame:03d}.jpg", action_m=2.0)


@pytest.fixture
def session(service, drives):
    """A session after three views."""
    with Client(service) as client, client.session("route") as live:
        drive(client, live, drives["winter"], range(5, 8))
        yield live


@pytest.fixture
def pages(service, session):
    """By fragment a text of every page, those of a session and a job included."""
    with httpx2.Client(base_url=service) as caller:
        job = caller.get("/v1/admin/jobs").json()["jobs"][0]["job_id"]
    return {**PAGES, f"sessions/{session.session_id}": "After 3 views", f"jobs/{job}": "What was measured"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_page_is_whole_and_accessible(open_page, pages, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed").Axe()
    page = open_page(color_scheme=scheme, viewport=DESK, bypass_csp=True)
    for fragment, text in pages.items():
        page.goto(page.url.partition("#")[0] + f"#{fragment}")
        page.get_by_text(text).first.wait_for()
        for width in (PHONE, DESK):
            page.set_viewport_size(width)
            assert page.evaluate(TOO_WIDE) == [], fragment
            report = axe.run(page)
            assert report.violations_count == 0, f"{fragment}: {report.generate_report()}"


@pytest.mark.parametrize(
    ("fragment", "advice"),
    [
        ("domains/none", "Choose one under Domains"),
        ("domains/none/upload", "Choose one under Domains"),
        ("sessions/none", "Open one under Sessions"),
        ("sessions/" + 64 * "0", "Open one under Sessions"),
        ("jobs/none", "Choose one under Jobs"),
    ],
)
def test_what_is_not_there_is_said_once_and_what_to_do(open_page, fragment, advice):
    page = open_page(fragment, expected="404", viewport=PHONE)
    page.get_by_role("alert").get_by_text(advice).wait_for()
    assert page.get_by_role("alert").count() == 1
    assert page.get_by_role("alert").evaluate("(alert) => alert.scrollWidth <= alert.clientWidth")


REACHABLE = """[...document.querySelectorAll("a[href], button, input, select, summary, iframe, [tabindex='0']")]
    .filter((part) => !part.disabled && part.checkVisibility())"""
REACHED = """(() => {
    const [here, look] = [document.activeElement, getComputedStyle(document.activeElement)];
    here.reached = true;
    return here.matches("body, main, iframe") || (look.outlineStyle === "solid" && parseFloat(look.outlineWidth) >= 2);
})()"""


def test_the_keyboard_reaches_all_of_every_page(open_page, session, pages):
    page = open_page()
    for fragment, text in pages.items():
        page.goto(page.url.partition("#")[0] + f"#{fragment}")
        page.get_by_text(text).first.wait_for()
        if fragment == "report":  # a frame that is still loading takes no focus
            page.frame_locator("iframe").get_by_label("or choose a file").wait_for()
        page.wait_for_timeout(300)
        for _ in range(page.evaluate(f"{REACHABLE}.length") + 4):
            page.keyboard.press("Tab")
            assert page.evaluate(REACHED), f"{fragment}: the focus is not seen"
        missed = page.evaluate(f"{REACHABLE}.filter((part) => !part.reached).map((part) => part.outerHTML)")
        assert missed == [], fragment
    page.goto(page.url.partition("#")[0] + f"#sessions/{session.session_id}")
    page.get_by_text("After 3 views").wait_for()
    slider = page.get_by_label("Step shown")
    slider.press("ArrowLeft")
    page.get_by_text("After 2 views").wait_for()
    slider.press("Home")
    page.get_by_text("After 1 view", exact=True).wait_for()


@pytest.mark.parametrize(("motion", "takes"), [("reduce", "0s"), ("no-preference", "0.15s")])
def test_bars_move_only_where_motion_is_not_reduced(open_page, session, motion, takes):
    page = open_page(f"sessions/{session.session_id}", reduced_motion=motion)
    page.get_by_text("After 3 views").wait_for()
    moving = """[...document.querySelectorAll("*")].map((part) => getComputedStyle(part))
        .filter((look) => look.animationName !== "none" || look.transitionDuration !== "0s")
        .map((look) => look.transitionDuration)"""
    assert set(page.evaluate(moving)) == ({takes} - {"0s"})


ON_A_LOOP = """import("./console/charts.js").then(({ Route }) => {
    const loop = { route_position_m: [5, 9, 12], x_m: [0, 4, 2], y_m: [0, 0, 2], closed: true, length_m: 10 };
    const route = new Route(loop);
    return [route.moved(12, 2), route.moved(12, 4), route.at(15)];
})"""


def test_a_loop_ends_where_it_began(open_page):
    assert open_page().evaluate(ON_A_LOOP) == [14, 6, {"x": 0, "y": 0}]


def test_a_chart_of_one_view_shows_it_and_its_numbers_fit(open_page, service, drives):
    with Client(service) as client, client.session("route") as live:
        drive(client, live, drives["winter"], range(5, 6))
        page = open_page(f"sessions/{live.session_id}")
        page.get_by_text("After 1 view", exact=True).wait_for()
        label_room = """(plot) => {
            const letters = document.createElement("canvas").getContext("2d");
            letters.font = "12px system-ui, sans-serif";
            return parseFloat(plot.style.left) - 15 - letters.measureText("100 %").width;
        }"""
        assert page.locator(".u-over").first.evaluate(label_room) >= 0
        has_colour = """(canvas) => {
            const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            return data.some((red, i) => i % 4 === 0 && data[i + 3] === 255 && data[i + 2] - red > 80);
        }"""
        assert page.locator(".u-wrap canvas").last.evaluate(has_colour)


def test_landmarks_are_shown_by_the_frames_they_began_as(open_page):
    page = open_page("domains/route")
    landmarks = page.locator("section").filter(has=page.get_by_role("heading", name="Landmarks"))
    landmarks.locator("img").first.wait_for()
    assert landmarks.get_by_role("listitem").count() == 12
    assert "listed by" in landmarks.inner_text()
    assert ".jpg" in landmarks.inner_text()
    assert "of summer" in landmarks.inner_text()
    landmarks.get_by_role("button", name=f"Show {N_FRAMES - 12} more").click()
    assert landmarks.locator("img").nth(N_FRAMES - 1).get_attribute("src").startswith("blob:")


def test_a_session_longer_than_what_is_kept_is_gone_through_to_its_first_step(open_page, service, drives):
    def keeps_four(route, _):
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.text().replace("MOST_EVENTS = 2000", "MOST_EVENTS = 4"))

    with Client(service) as client, client.session("route") as live:
        drive(client, live, drives["winter"], range(4, 14))
        page = open_page()
        page.route("**/console/sessions.js", keeps_four)
        page.goto(f"{service}/console#sessions/{live.session_id}")
        page.reload()
        page.get_by_text("After 10 views").wait_for()
        page.get_by_text("Events 7 to 10").wait_for()
        page.get_by_role("button", name="Those before").click()
        page.get_by_text("After 6 views").wait_for()
        page.get_by_text("Events 3 to 6").wait_for()
        page.get_by_label("Step shown").press("Home")
        page.get_by_text("After 3 views").wait_for()
        page.get_by_role("button", name="One step back").click()
        page.get_by_text("After 2 views").wait_for()
        page.get_by_role("button", name="One step on").click()
        page.get_by_text("After 3 views").wait_for()
        page.get_by_role("button", name="Follow live").click()
        page.get_by_text("After 10 views").wait_for()


def test_the_keyboard_goes_everywhere_in_order_and_is_seen(open_page):
    page = open_page("report")
    page.get_by_role("heading", name="Reports").wait_for()
    ring = "getComputedStyle(document.activeElement)"
    passed = []
    for _ in range(9):
        page.keyboard.press("Tab")
        passed.append(page.evaluate("document.activeElement.textContent"))
        assert page.evaluate(f"{ring}.outlineStyle") == "solid"
        assert page.evaluate(f"parseFloat({ring}.outlineWidth)") >= 2
    bar = ["Skip to the content", "Deep SIMBAD", "Domains", "Sessions", "Try it", "Jobs", "Reports", "Enter a key"]
    assert passed == [*bar, "Open another"]
    page.get_by_role("link", name="Skip to the content").press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Open another", "past the links"


def test_a_robot_that_drives_is_seen_and_gone_through_step_by_step(open_page, service, drives):
    with Client(service) as client, client.session("route") as live:
        page = open_page(f"sessions/{live.session_id}")
        page.get_by_text("Waiting for its first view").wait_for()
        robot = threading.Thread(target=drive, args=(client, live, drives["winter"], range(4, 16)))
        robot.start()
        page.get_by_text("After 12 views").wait_for()
        robot.join()
        answer = live.state()
        figures = page.locator("dl.figures").first.inner_text()
        assert f"{answer.belief.mode_m:.1f} m" in figures
        assert f"{answer.belief.entropy_bits:.1f}" in figures
        page.get_by_role("button", name="One step back").click()
        page.get_by_text("After 11 views").wait_for()
        page.get_by_label("Step shown").press("Home")
        page.get_by_text("After 1 view", exact=True).wait_for()
        assert page.get_by_role("button", name="One step back").is_disabled()
        page.get_by_role("button", name="Follow live").click()
        page.get_by_text("After 12 views").wait_for()
        page.locator(".places img").first.wait_for()  # thumbnails of the places
        page.get_by_alt_text("The view").wait_for()
        with httpx2.Client(base_url=service) as caller:
            caller.delete(f"/v1/sessions/{live.session_id}")
        page.get_by_text("the session has ended").wait_for()


def test_an_image_is_tried_and_an_episode_gone_through(open_page, drives):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed").Axe()
    page = open_page("try/route", bypass_csp=True)
    page.set_input_files("input[type=file]", drives["winter"] / "009.jpg")
    page.get_by_text("After this one view").wait_for()
    assert (report := axe.run(page)).violations_count == 0, report.generate_report()
    assert page.get_by_alt_text("The view").is_visible()
    for motion, duration in (("reduce", "0s"), ("no-preference", "0.15s")):
        page.emulate_media(reduced_motion=motion)
        bar = page.locator(".moves .fill").first
        assert bar.evaluate("(bar) => getComputedStyle(bar).transitionDuration") == duration
    page.get_by_role("button", name="key").press("Enter")
    page.get_by_role("dialog", name="API key").press("Escape")
    assert page.get_by_text("After this one view").is_visible(), "a dialog that is left changes nothing"
    page.get_by_role("button", name="Go through an episode, view by view").click()
    page.get_by_text("Nothing is known yet").wait_for()
    page.set_input_files("input[type=file]", drives["winter"] / "009.jpg")
    page.get_by_text("After 1 view", exact=True).wait_for()
    page.get_by_label("Metres driven since the last view").fill("2")
    drop(page, drives["winter"] / "010.jpg", "image/jpeg")
    page.get_by_text("After 2 views").wait_for()
    assert (report := axe.run(page)).violations_count == 0, report.generate_report()
    page.get_by_role("button", name="End the episode").press("Enter")
    page.get_by_text("Drop an image of the route here").wait_for()
    (drives["winter"].parent / "broken.jpg").write_bytes(b"no picture")
    page = open_page("try/route", expected="422")
    page.set_input_files("input[type=file]", drives["winter"].parent / "broken.jpg")
    page.get_by_role("alert").get_by_text("undecodable_image").wait_for()


def test_a_folder_is_uploaded_mapped_and_rolled_back(open_page, service, drives):
    make_domain(service, "made", drives["summer"])
    page = open_page("domains/made/upload")
    page.set_input_files("input[type=file]", drives["winter"])
    page.get_by_text(f"{N_FRAMES} images").wait_for()
    page.get_by_label("Metres between images").fill("2")
    page.get_by_role("button", name="Upload").click()
    page.get_by_text(f"{N_FRAMES} of {N_FRAMES} images").wait_for()
    page.get_by_label("Drive that becomes the map").select_option("winter")
    page.get_by_role("button", name="Remap").click()
    page.get_by_text("Map version 2 answers now.").wait_for()
    page.get_by_text("It learnt nothing of a second season: without x, y").wait_for()
    page.reload()  # its log is the job's, whenever somebody looks
    page.get_by_text("Map version 2 answers now.").wait_for()
    log = [line.split("\n")[0].lower() for line in page.locator(".log li").all_inner_texts()]
    assert log == ["asked for", "begun", "read frames", "describe", "train", "check", "succeeded"]
    page.get_by_role("link", name="See it").click()
    page.get_by_role("button", name="Roll back").press("Enter")
    page.get_by_role("dialog").press("Escape")
    page.get_by_role("dialog").wait_for(state="hidden")
    assert page.get_by_role("button", name="Roll back").evaluate("(button) => button === document.activeElement")
    page.get_by_role("row", name="2 active").wait_for()
    page.get_by_role("button", name="Roll back").click()
    dialog = page.get_by_role("dialog", name="Roll back made to map 1?")
    assert "no longer by map 2" in dialog.inner_text()
    dialog.get_by_role("button", name="Roll back").click()
    page.get_by_role("row", name="1 active").wait_for()
    with httpx2.Client(base_url=service) as caller:
        assert caller.get("/v1/domains/made").json()["map_version"] == 1


def test_an_upload_is_paused_and_goes_on_without_what_is_no_picture(open_page, service, drives, tmp_path):
    folder = tmp_path / "autumn"
    shutil.copytree(drives["winter"], folder)
    (folder / "007.jpg").write_bytes(b"no picture")
    page = open_page(expected="422")
    page.get_by_text("Make a domain").click()
    page.get_by_label("Name: letters").fill("paused")
    page.get_by_role("button", name="Make it").click()
    routes = []
    page.route("**/frames/5?*", lambda route, _: routes.append(route))
    page.set_input_files("input[type=file]", folder)
    page.get_by_role("button", name="Upload").click()
    page.get_by_text(f"{N_FRAMES - 1} of {N_FRAMES} images").wait_for()
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Go on").wait_for()
    page.unroute("**/frames/5?*")
    page.get_by_role("button", name="Go on").click()
    page.get_by_text(f"{N_FRAMES} of {N_FRAMES} images").wait_for()
    page.get_by_text("007.jpg").wait_for()
    page.get_by_text("1 refused, the others are taken").wait_for()
    with httpx2.Client(base_url=service) as caller:
        stored = caller.get("/v1/admin/domains/paused/traverses/autumn").json()
        assert (stored["n_frames"], stored["missing"]) == (N_FRAMES - 1, [[7, 7]])


def test_an_upload_goes_on_where_it_was_cut(open_page, service, drives):
    make_domain(service, "cut", None)
    frames = sorted(drives["summer"].iterdir())
    base = "/v1/admin/domains/cut/traverses"
    with httpx2.Client(base_url=service) as caller:
        caller.post(base, json={"name": "summer"})
        for index in (0, 1, 4):  # what was under way is missing between
            query = f"position_m={index}&name={frames[index].name}"
            caller.put(
                f"{base}/summer/frames/{index}?{query}",
                content=frames[index].read_bytes(),
                headers={"Content-Type": "image/jpeg"},
            ).raise_for_status()
        page = open_page("domains/cut/upload")
        urls = []
        page.on("request", lambda request: urls.append(request.url) if request.method == "PUT" else None)
        page.set_input_files("input[type=file]", drives["summer"])
        page.get_by_role("button", name="Upload").click()
        page.get_by_text(f"{N_FRAMES} of {N_FRAMES} images").wait_for()
        assert len(urls) == N_FRAMES - 3
        stored = caller.get(f"{base}/summer").json()
        assert (stored["n_frames"], stored["missing"]) == (N_FRAMES, [])


def test_a_lost_connection_is_said_and_mended(open_page, tmp_path, drives):
    with serving(tmp_path) as url:
        make_domain(url, "route", drives["summer"])
        port = int(url.rpartition(":")[2])
        with Client(url) as client:
            live = client.session("route", keep=True)
            drive(client, live, drives["winter"], range(5, 8))
        page = open_page(f"sessions/{live.session_id}", url, expected="net::ERR")
        page.get_by_text("After 3 views").wait_for()
        other = open_page("report", url, expected="net::ERR")
        other.get_by_role("heading", name="Reports").wait_for()
    page.get_by_text("connection lost, trying again").wait_for()
    other.evaluate("location.hash = 'domains/route'")
    other.get_by_role("alert").get_by_text("no_connection").first.wait_for()
    behind = []
    page.on("request", lambda request: behind.append(request.headers.get("last-event-id")))
    with serving(tmp_path, port) as url, Client(url) as client:
        page.get_by_text("live", exact=True).wait_for()
        assert "3" in behind
        other.get_by_text("How surely a place is recognised").wait_for()
        client.attach_session(live.session_id).observe(image=drives["winter"] / "008.jpg", action_m=2.0)
        page.get_by_text("After 4 views").wait_for()
        assert page.get_by_label("Step shown").get_attribute("max") == "3", "no step came twice"


def test_a_key_is_asked_refused_and_kept_in_the_tab_alone(open_page, tmp_path, drives):
    with Catalog.open(tmp_path) as catalog:
        key = catalog.create_key(KeyScope.ADMIN)[1].text
    with serving(tmp_path) as url:
        make_domain(url, "route", drives["summer"], **{"X-API-Key": key})
        page = open_page("domains/route", url, expected="401")
        page.get_by_text("This service asks for a key").first.wait_for()
        for text, answer in (("wrong", "unauthorized"), (key, "How surely a place is recognised")):
            page.get_by_role("button", name="key").click()
            page.get_by_role("textbox", name="Key").fill(text)
            page.get_by_role("button", name="Use it").click()
            page.get_by_text(answer).first.wait_for()
        assert page.evaluate("Object.keys(localStorage).length") == 0
        assert page.context.cookies() == []
        page.close()  # before its service ends, which it would complain of


def tried(folder, drives, url):
    options = ("--evaluator", "feature_l2:gradient_grid", "--out", folder)
    assert deepsimbad(["try", *map(str, (drives["summer"], drives["winter"], *options))]) == 0


def replayed(folder, drives, url):
    options = ("--domain", "route", "--server", url, "--out", folder)
    assert deepsimbad_client(["replay", *map(str, (drives["winter"], *options))]) == 0


def told_of_the_paper(folder, drives, url):
    rng, nclt = np.random.default_rng(2), folder / "nclt"
    nclt.mkdir(parents=True)
    places = rng.normal(size=(112, 12))
    for date in ("2012-01-22", "2012-03-31", "2012-08-04"):
        np.save(nclt / f"{date}.npy", (places + 0.5 * rng.normal(size=places.shape)).astype(np.float32))
    small = ("--n-landmarks", 8, "--training-episodes", 20, "--episodes", 2, "--evaluator", "feature_l2:none")
    options = ("--nclt", nclt, "--out", folder, *small)
    assert deepsimbad(["experiment", "paper", *map(str, options)]) == 0


@pytest.mark.parametrize(
    ("write", "text"),
    [
        (tried, "find their place at first sight"),
        (replayed, "winter against route"),
        (told_of_the_paper, "Brute force"),
    ],
)
def test_every_report_is_opened_in_a_frame_of_its_own(open_page, service, drives, tmp_path, write, text):
    write(tmp_path / "out", drives, service)
    page = open_page("report")
    frame = page.frame_locator("iframe")
    frame.locator("input[type=file]").set_input_files(tmp_path / "out" / "index.html")
    frame.get_by_text(text).first.wait_for()
    (inner,) = page.frames[1:]
    for picture in frame.locator("img").all()[:1]:
        picture.scroll_into_view_if_needed()
        assert picture.evaluate("(picture) => picture.decode().then(() => picture.naturalWidth)") > 0
    assert inner.evaluate("(() => { try { return parent.document.title } catch { return null } })()") is None
    page.get_by_role("button", name="Open another").click()
    frame.get_by_text("Drop a report here").wait_for()
    drop(page, tmp_path / "out" / "index.html", "text/html")
    frame.get_by_text(text).first.wait_for()
    page.get_by_role("button", name="Open another").click()
    frame.get_by_text("Drop a report here").wait_for()
    (tmp_path / "notes.txt").write_text("nothing of the kind")
    frame.locator("input[type=file]").set_input_files(tmp_path / "notes.txt")
    frame.get_by_text("notes.txt is no page").wait_for()


def test_licences_are_beside_what_was_not_made_here():
    licences = Path(str(resources.files("deepsimbad") / "console" / "licences.txt")).read_text()
    for name in ("Preact", "htm", "uPlot"):
        assert name in licences
