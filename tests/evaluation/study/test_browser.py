"""The pages in Chromium: on a phone, on a desktop, and by keyboard."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pandas as pd
import pytest
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from dynapix.evaluation.study import storage
from dynapix.evaluation.study.storage import read_votes
from tests.evaluation.chromium import IS_TOO_WIDE, chromium_in
from tests.evaluation.study.running import rows

pytestmark = pytest.mark.slow

PATIENCE = 60
MIN_TARGET = 44
"""Smallest side of a touch target, in pixels."""


@pytest.fixture(scope="module")
def chromium(tmp_path_factory) -> Iterator[webdriver.Chrome]:
    yield from chromium_in(tmp_path_factory.mktemp("chromium"))


def sign_in(browser: webdriver.Chrome, served, name: str) -> None:
    browser.get(f"http://127.0.0.1:{served.port}{served.links()[name]}")


def find(browser: webdriver.Chrome, what: str) -> WebElement:
    return browser.find_element(By.CSS_SELECTOR, what)


def await_page(browser: webdriver.Chrome) -> str:
    """Wait until a page is loaded. Return the text of its main button, or of its heading."""
    WebDriverWait(browser, PATIENCE, 0.05).until(
        lambda b: (
            b.execute_script("return document.readyState") == "complete"
            and not b.find_elements(By.CSS_SELECTOR, ".loading")
        )
    )
    buttons = browser.find_elements(By.CSS_SELECTOR, "button.primary")
    return buttons[0].text if buttons else find(browser, "h1").text


def await_next(browser: webdriver.Chrome, act: Callable[[], None]) -> str:
    """Call `act`, wait for the next page, and return its text as `await_page` does."""
    browser.execute_script("window.unchanged = true")
    act()
    WebDriverWait(browser, PATIENCE, 0.05).until(
        lambda b: not b.execute_script("return window.unchanged === true")
    )
    return await_page(browser)


def votes(served, name: str) -> pd.DataFrame:
    db = storage.open_study(served.folder / storage.DATABASE)
    found = read_votes(db)
    db.close()
    return found[found.annotator == name]


def check_fits(browser: webdriver.Chrome) -> None:
    assert not browser.execute_script(IS_TOO_WIDE), "the page is wider than the screen"
    for target in browser.find_elements(By.CSS_SELECTOR, "button, label, .button"):
        assert min(target.size.values()) >= MIN_TARGET, target.text


@pytest.mark.parametrize(
    ("name", "width", "height", "phone"),
    [("A1", 390, 844, True), ("A2", 1280, 800, False)],
    ids=["phone", "desktop"],
)
def test_pages_fit_the_screen_and_answers_are_stored(
    chromium, small, name, width, height, phone
) -> None:
    screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    sign_in(chromium, small, name)
    seen, answers = [await_page(chromium)], []
    while seen[-1] != "Thank you":
        assert chromium.execute_script("return innerWidth") == width
        check_fits(chromium)
        if seen[-1] == "Confirm":
            label = chromium.find_elements(By.TAG_NAME, "label")[len(answers)]
            assert not find(chromium, "button.primary").is_enabled()
            label.click()
            answers.append(label.text)
        seen.append(await_next(chromium, find(chromium, "button.primary").click))
    assert seen == ["I agree to take part", *["Confirm"] * 4, "Thank you"]
    found = votes(small, name)
    assert list(found.letter) == answers == ["A", "B", "C", "D"]
    assert (found.loads == 1).all()


def test_keys_answer_and_a_reloaded_page_has_the_same_question(chromium, small) -> None:
    chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

    def press(*keys: str) -> Callable[[], None]:
        return lambda: ActionChains(chromium).send_keys(*keys).perform()

    sign_in(chromium, small, "A3")
    page, answers = await_page(chromium), []
    keys_by_page = [("b",), ("3",), ("a", "d"), ("c", Keys.ARROW_RIGHT)]
    while page != "Thank you":
        if page == "Confirm":
            question = find(chromium, "main").get_attribute("data-key")
            if len(answers) == 1:
                chromium.get(chromium.current_url)
                assert await_page(chromium) == "Confirm"
                assert find(chromium, "main").get_attribute("data-key") == question
            for key in keys_by_page[len(answers)]:
                press(key)()
            chosen = find(chromium, "input:checked")
            answers.append(chosen.get_attribute("value"))
            assert chromium.switch_to.active_element == chosen
        page = await_next(chromium, press(Keys.ENTER))
    assert answers == ["B", "C", "D", "D"]
    found = votes(small, "A3")
    assert list(found.letter) == answers
    assert list(found.loads) == [1, 2, 1, 1]


def test_the_video_replays_and_an_answer_survives_a_restart(
    chromium, serve, prepared_small
) -> None:
    served = serve(prepared_small)
    sign_in(chromium, served, "A1")
    await_page(chromium)
    await_next(chromium, find(chromium, "button.primary").click)

    def ended(browser: webdriver.Chrome) -> bool:
        return browser.execute_script("return document.querySelector('video').ended")

    for act in (ActionChains(chromium).send_keys("r").perform, find(chromium, "#replay").click):
        WebDriverWait(chromium, PATIENCE, 0.05).until(ended)
        act()
        assert not ended(chromium)
    assert find(chromium, "video").get_attribute("src").startswith("blob:")
    assert not [e for e in chromium.get_log("browser") if e["level"] == "SEVERE"]

    key = find(chromium, "main").get_attribute("data-key")
    chromium.find_elements(By.TAG_NAME, "label")[1].click()
    served.kill()
    chromium.execute_script("window.unchanged = true")
    find(chromium, "button.primary").click()
    WebDriverWait(chromium, PATIENCE, 0.05).until(
        lambda b: "cannot be reached" in find(b, "#status").text
    )
    served.start()
    WebDriverWait(chromium, PATIENCE, 0.05).until(
        lambda b: not b.execute_script("return window.unchanged === true")
    )
    assert await_page(chromium) == "Confirm"
    [turn] = rows(served, "SELECT letter FROM turn WHERE token = ?", key)
    assert turn["letter"] == "B"
