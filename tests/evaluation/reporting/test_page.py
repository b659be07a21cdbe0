"""The page in Chromium, from its file alone: on narrow and wide screens, light and dark, by mouse
and by keyboard."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from dynapix.conf.entry import Run
from dynapix.conf.schema import ReportCommand
from dynapix.evaluation import report
from tests.evaluation.chromium import IS_TOO_WIDE, chromium_in
from tests.evaluation.reporting.conftest import HOSTILE

pytestmark = pytest.mark.slow

LUMINANCE = """
const [r, g, b] = getComputedStyle(arguments[0])[arguments[1]].match(/[\\d.]+/g).map(Number);
return (0.2126 * r + 0.7152 * g + 0.0722 * b) / 255
"""
REQUESTED = """
const found = performance.getEntriesByType("resource").map((entry) => entry.name);
return found.filter((name) => !name.startsWith("data:"));
"""
SHOWN = "return [...document.querySelectorAll('article')].map(a => a.dataset.id)"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory) -> Iterator[webdriver.Chrome]:
    yield from chromium_in(tmp_path_factory.mktemp("chromium"))


@pytest.fixture(scope="module")
def page(measured, micro_store, tmp_path_factory) -> Path:
    """The page, moved out of the run folder and away from its other files."""
    folder = tmp_path_factory.mktemp("report")
    cfg = ReportCommand(checkpoints=str(measured), store=str(micro_store.folder.parent), items=60)
    report.main.__wrapped__(cfg, Run("default", folder))
    moved = tmp_path_factory.mktemp("elsewhere") / "page.html"
    shutil.move(folder / "report.html", moved)
    return moved


def open_page(browser: webdriver.Chrome, page: Path, width: int, light: str = "light") -> None:
    screen = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    scheme = [{"name": "prefers-color-scheme", "value": light}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    browser.get(page.as_uri())


def choose(browser: webdriver.Chrome, **values: str) -> list[str]:
    """Set filters, show all items that match, and return their ids."""
    for name, value in values.items():
        Select(browser.find_element(By.NAME, name)).select_by_value(value)
    more = browser.find_element(By.ID, "more")
    while more.is_displayed():
        more.send_keys(Keys.ENTER)
    return browser.execute_script(SHOWN)


def items_of(browser: webdriver.Chrome) -> list[dict]:
    data = browser.execute_script("return document.getElementById('data').textContent")
    return json.loads(data)["items"]


@pytest.mark.parametrize(("width", "light"), [(360, "dark"), (1280, "light")])
def test_the_page_fits_the_screen_and_has_contrast(chromium, page, width, light):
    open_page(chromium, page, width, light)
    for fold in chromium.find_elements(By.TAG_NAME, "summary"):
        fold.click()
    # The name of a run may be long.
    chromium.execute_script(
        "document.getElementsByName('model')[0].add(new Option('run'.repeat(30)))"
    )
    assert not chromium.execute_script(IS_TOO_WIDE)
    for name in ("body", "td", "svg text"):
        part = chromium.find_element(By.CSS_SELECTOR, name)
        ink = chromium.execute_script(LUMINANCE, part, "fill" if name == "svg text" else "color")
        assert ink > 0.7 if light == "dark" else ink < 0.3
    card = chromium.find_element(By.CSS_SELECTOR, ".scroll")
    behind = chromium.execute_script(LUMINANCE, card, "backgroundColor")
    assert behind < 0.2 if light == "dark" else behind > 0.9


def test_the_page_sends_no_request_and_logs_no_error(chromium, page):
    chromium.get_log("browser")
    open_page(chromium, page, 1280)
    choose(chromium)
    assert chromium.execute_script(REQUESTED) == []
    # Violations of the page's content security policy would be logged here, too.
    assert chromium.get_log("browser") == []
    chromium.execute_script("new Image().src = 'http://127.0.0.1:9/x.png'")
    [refused] = chromium.get_log("browser")
    assert "Content Security Policy" in refused["message"]


def test_responses_are_shown_as_text_without_markup(chromium, page):
    open_page(chromium, page, 1280)
    choose(chromium)
    assert chromium.title == "DynaPix report"
    texts = "return [...document.querySelectorAll('pre')].map((pre) => pre.textContent)"
    assert HOSTILE in chromium.execute_script(texts)
    assert chromium.find_elements(By.CSS_SELECTOR, "pre *") == []


def test_an_item_shows_its_frames_and_marks_the_target(chromium, page):
    open_page(chromium, page, 1280)
    item = next(i for i in items_of(chromium) if i["id"] == choose(chromium)[0])
    article = chromium.find_element(By.TAG_NAME, "article")
    images = article.find_elements(By.TAG_NAME, "img")
    assert len(images) == len(item["prefix"]) + 4
    assert all(chromium.execute_script("return arguments[0].naturalWidth", i) for i in images)
    [target] = article.find_elements(By.CLASS_NAME, "target")
    assert target.text.startswith(f"{item['answer']}: target")
    assert item["question"] in article.text


def test_filters_select_items(chromium, page):
    open_page(chromium, page, 1280)
    items = items_of(chromium)
    assert len(choose(chromium)) == len(items) == 60
    for family in ("event", "time", "window"):
        assert choose(chromium, family=family) == [i["id"] for i in items if i["family"] == family]
    options = Select(chromium.find_element(By.NAME, "subtype")).options
    subtypes = {i["subtype"] for i in items if i["family"] == "window"}
    assert {o.text for o in options} == {"any", *subtypes}
    subtype = sorted(subtypes)[0]
    assert choose(chromium, subtype=subtype) == [
        i["id"] for i in items if i["family"] == "window" and i["subtype"] == subtype
    ]
    # Another family has other subtypes, so the filter of subtypes is reset.
    assert choose(chromium, family="time") == [i["id"] for i in items if i["family"] == "time"]
    label = "small base (record)"
    of_base = {i["id"]: s["verdict"] for i in items for s in i["responses"] if s["model"] == label}
    for verdict in ("correct", "wrong"):
        wanted = [name for name, of_item in of_base.items() if of_item == verdict]
        assert choose(chromium, family="any", model=label, verdict=verdict) == wanted
    assert choose(chromium, model="cot (reasoning)", verdict="wrong") == []
    assert chromium.find_element(By.ID, "count").text == "0 of 60 items"
