"""The report in a real Chromium: narrow and wide windows, print, dark mode."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import EXECUTABLE, Browser, chromium
from small_comparison import make_comparison

from bmask_slam.comparison.report import write_report

pytestmark = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium: apt-get install chromium (.ci/run does)"
)
PHONE_PX, DESK_PX = 360, 1200
A4_PX = 688  # the style's margins taken off 210 mm, at 96 px an inch
BEYOND = """
[...document.querySelectorAll('body *')]
  .filter(e => !e.parentElement.closest('.scroll, pre') || getComputedStyle(
    e.parentElement.closest('.scroll, pre')).overflowX === 'visible')
  .filter(e => e.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
  .map(e => e.tagName + ': ' + e.textContent.trim().slice(0, 60))
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(make_comparison(folder), folder)
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    ("width_px", "media"), [(PHONE_PX, "screen"), (DESK_PX, "screen"), (A4_PX, "print")]
)
def test_the_page_has_no_horizontal_overflow(browser, page, width_px, media, scheme):
    browser.open(page, width_px, media, scheme)
    width = browser.evaluate("document.documentElement.clientWidth")
    assert width == width_px
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate(BEYOND) == []


def test_all_pictures_load_without_other_requests(browser, page):
    browser.open(page, PHONE_PX)
    pictures = browser.evaluate("[...document.images].map(i => i.complete && i.naturalWidth > 100)")
    assert len(pictures) >= 5
    assert all(pictures)
    assert browser.requests() == [page.resolve().as_uri()]
    errors = [
        e
        for e in browser.events
        if e.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown")
    ]
    assert errors == []


def test_wide_tables_scroll_within_their_box_and_by_keyboard(browser, page):
    browser.open(page, PHONE_PX)
    each = "b => [b.scrollWidth > b.clientWidth, b.tabIndex]"
    boxes = browser.evaluate(f"[...document.querySelectorAll('.scroll')].map({each})")
    assert any(wide for wide, _ in boxes)
    assert all(index == 0 for _, index in boxes)


def test_text_can_be_read_on_both_backgrounds(browser, page):
    """Contrast of at least 4.5 to 1 (WCAG 2.2, 1.4.3) of every text with the page's background."""
    for scheme in ("light", "dark"):
        browser.open(page, DESK_PX, scheme=scheme)
        assert browser.evaluate(CONTRAST) >= 4.5, scheme


def test_it_prints(browser, page):
    """Headings stay with their content, rows and figures are not split, paper is white."""
    browser.open(page, DESK_PX, "print")
    pdf = browser.print_pdf()
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page[^s]", pdf)) <= 2
    browser.open(page, A4_PX, "print", "dark")
    kept = {"h2": "breakAfter", "h3": "breakAfter", "tr": "breakInside", "figure": "breakInside",
            ".caption": "breakBefore"}  # fmt: skip
    for selector, rule in kept.items():
        each = f"e => getComputedStyle(e).{rule}"
        found = browser.evaluate(f"[...document.querySelectorAll('{selector}')].map({each})")
        assert set(found) == {"avoid"}, selector
    paper = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert paper == "rgb(255, 255, 255)"
    assert browser.evaluate("getComputedStyle(document.querySelector('nav')).display") == "none"


CONTRAST = """
(() => {
  const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(v => v / 255).map(
    v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const paper = light(getComputedStyle(document.body).backgroundColor);
  const texts = [...document.querySelectorAll('body *')].filter(e => e.textContent.trim());
  return Math.min(...texts.map(e => {
    const ink = light(getComputedStyle(e).color);
    return (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05); }));
})()
"""
