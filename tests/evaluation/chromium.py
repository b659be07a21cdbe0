"""A headless Chromium in which tests open pages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
IS_TOO_WIDE = "return document.documentElement.scrollWidth > document.documentElement.clientWidth"


def chromium_in(profile: Path) -> Iterator[webdriver.Chrome]:
    """Yield a browser that has its profile in a folder and records its console; then close it."""
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    assert browser, "pages are tested in Chromium: apt-get install chromium"
    assert driver, "pages are tested in Chromium: apt-get install chromium-driver"
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    opened = webdriver.Chrome(options=options, service=Service(driver))
    yield opened
    opened.quit()
