"""The page in the hand: it fits the screen, scrolls under a finger, turns under two, and its pictures enlarge."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Browser

from slamcli.report import make
from slamcli.runs.run_directory import RunDir

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTHS = (400, 800, 1300)
SCENE = "document.getElementById('scene').toDataURL()"

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")


@pytest.fixture(scope="module")
def page(room_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    make(RunDir.find(str(room_run)), path)
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(str(CHROMIUM), tmp_path_factory.mktemp("profile")) as one:
        yield one


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_fits_the_screen_and_says_nothing_to_the_console(browser: Browser, page: Path, width: int) -> None:
    browser.open(page, width=width)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run("[...document.querySelectorAll('canvas')].every(c => c.clientWidth > 200 && c.clientHeight > 90)")
    assert browser.run("Math.max(...[...document.querySelectorAll('tr')].map(r => r.clientHeight))") < 100
    assert browser.errors == []


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("where", ["#scene", "#charts canvas"])
def test_a_finger_on_the_scene_or_a_chart_scrolls_the_page(browser: Browser, page: Path, width: int, where: str) -> None:
    browser.open(page, width=width, touch=True)
    x, y = browser.middle(where)
    before, drawn = browser.run("scrollY"), browser.run(SCENE)
    browser.touch("touchStart", (x, y))
    for up in range(20, 220, 20):
        browser.touch("touchMove", (x, y - up))
    browser.touch("touchEnd")
    assert browser.run("scrollY") > before + 100
    if where == "#scene":
        assert browser.run(SCENE) == drawn


def test_the_wheel_scrolls_and_with_ctrl_it_zooms(browser: Browser, page: Path) -> None:
    browser.open(page, width=1300)
    x, y = browser.middle("#scene")
    before, drawn = browser.run("scrollY"), browser.run(SCENE)
    browser.send("Input.synthesizeScrollGesture", x=x, y=y, yDistance=-200, gestureSourceType="mouse", speed=2000)
    assert browser.run("scrollY") > before + 100
    assert browser.run(SCENE) == drawn
    x, y = browser.middle("#scene")
    browser.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-100, modifiers=2)
    assert browser.run(SCENE) != drawn


def test_a_mouse_turns_the_scene_and_buttons_zoom_it(browser: Browser, page: Path) -> None:
    browser.open(page, width=1300)
    x, y = browser.middle("#scene")
    drawn = browser.run(SCENE)
    browser.drag(x, y, 60, 20)
    turned = browser.run(SCENE)
    assert turned != drawn
    browser.click(*browser.middle("#zoom-in"))
    assert browser.run(SCENE) != turned
    browser.click(*browser.middle("#zoom-reset"))
    assert browser.run(SCENE) == drawn


def test_two_fingers_turn_and_zoom_the_scene_and_not_the_page(browser: Browser, page: Path) -> None:
    browser.open(page, width=400, touch=True)
    x, y = browser.middle("#scene")
    before, drawn = browser.run("scrollY"), browser.run(SCENE)
    browser.touch("touchStart", (x - 30, y), (x + 30, y))
    browser.touch("touchMove", (x - 60, y + 10), (x + 60, y + 10))
    assert browser.run(SCENE) != drawn
    browser.touch("touchEnd")
    assert browser.run("scrollY") == before
    assert browser.run("visualViewport.scale") == 1


def test_a_gesture_that_the_browser_takes_over_leaves_no_selection_behind(browser: Browser, page: Path) -> None:
    browser.open(page, width=400, touch=True)
    chart = "document.querySelector('#charts canvas')"
    browser.middle("#charts canvas")
    send = "{c}.dispatchEvent(new PointerEvent('{kind}', {{pointerId: 1, pointerType: 'touch', clientX: {x}, clientY: 5, bubbles: true}}))"
    drawn = browser.run(f"{chart}.toDataURL()")
    for kind, x in (("pointerdown", 120), ("pointermove", 200), ("pointercancel", 200), ("pointermove", 120), ("pointerleave", 120)):
        browser.run(send.format(c=chart, kind=kind, x=x))
    assert browser.run(f"{chart}.toDataURL()") == drawn


@pytest.mark.parametrize("width", WIDTHS)
def test_a_picture_enlarges_on_a_click_and_closes_on_the_next(browser: Browser, page: Path, width: int) -> None:
    browser.open(page, width=width)
    shown = "document.getElementById('large').open"
    small = browser.run("document.querySelector('figure img').clientWidth")
    assert not browser.run(shown)
    browser.click(*browser.middle("figure img"))
    assert browser.run(shown)
    assert browser.run("document.querySelector('#large img').clientWidth") > small
    browser.click(width / 2, 300)
    assert not browser.run(shown)


def test_a_chart_that_says_one_number_is_left_out(browser: Browser, page: Path) -> None:
    text = page.read_text()
    start = text.index('"inliers":[')
    flat = page.with_name("flat.html")
    flat.write_text(text[:start] + '"inliers":[' + ",".join(["7"] * 40) + text[text.index("]", start) :])
    browser.open(page, width=800)
    n = browser.run("document.querySelectorAll('#charts canvas').length")
    browser.open(flat, width=800)
    assert browser.run("document.querySelectorAll('#charts canvas').length") == n - 1
    assert "landmarks a pose rests on: 7 in every frame" in browser.run("document.getElementById('constant').textContent")
