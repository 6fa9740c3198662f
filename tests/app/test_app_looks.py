"""How the app looks on phones, tablets and laptops in both schemes: it fits, and everything can be read and reached."""

import contextlib
import itertools

import pytest

from .conftest import LONG, open_another, press, wait_for_result

SIZES = ((390, 844), (768, 1024), (1280, 860), (1440, 900))
SCHEMES = ("light", "dark")
pytestmark = pytest.mark.long

# Texts whose contrast with what is behind them is too low by WCAG AA; what is disabled may be.
FAINT = """() => {
  const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const linear = (value) => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const over = ([r, g, b, a = 1], [x, y, z]) => [a * r + (1 - a) * x, a * g + (1 - a) * y, a * b + (1 - a) * z];
  const parse = (colour) => {
    const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    context.fillStyle = colour;
    context.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = context.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const ground = (element) => {
    if (!element) return [255, 255, 255];
    const own = parse(getComputedStyle(element).backgroundColor);
    return own[3] === 1 ? own : over(own, ground(element.parentElement));
  };
  const faint = [];
  for (const element of document.querySelectorAll("body *")) {
    const style = getComputedStyle(element);
    const text = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    const idle = element.closest("[disabled], .disabled, [aria-disabled=true], figcaption, option");
    if (!text || idle || !element.checkVisibility({ visibilityProperty: true })) continue;
    const behind = ground(element), one = light(behind), other = light(over(parse(style.color), behind));
    const ratio = (Math.max(one, other) + 0.05) / (Math.min(one, other) + 0.05);
    if (ratio < 4.5) faint.push([element.textContent.trim().slice(0, 40), ratio.toFixed(2)]);
  }
  return faint;
}"""
# Name of what has the focus, and whether it, its field, its box or its bar looks other than without.
FOCUS = """() => {
  const element = document.activeElement;
  const name = element.ariaLabel || element.labels?.[0]?.textContent || element.closest("[aria-label]")?.ariaLabel;
  const within = element.querySelectorAll("[class*=track], [class*=bg]");
  const parts = [element, element.closest(".q-field__control") ?? element, ...within];
  const look = () => parts.map((part) => getComputedStyle(part)).map((style) => style.outline + style.boxShadow).join();
  const focused = look();
  element.blur();
  const plain = look();
  element.focus();
  return [element.tagName, (name || element.textContent).trim(), focused !== plain];
}"""


# Rules and elements of what axe-core finds serious or worse.  Styles of other servers, which it would load, there are
# none.
SERIOUS = """async () => {
  const { violations } = await axe.run({ resultTypes: ["violations"], preload: false });
  const serious = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  return serious.flatMap(({ id, nodes }) => nodes.map(({ target }) => [id, target]));
}"""


def sideways(page):
    return page.evaluate("document.documentElement.scrollWidth - innerWidth")


def show_in(page, scheme):
    """Have the page in a light or dark scheme; a script of the library follows it."""
    page.emulate_media(color_scheme=scheme)
    page.wait_for_function(f"document.body.classList.contains('body--{scheme}')")


def open_all(page):
    """Open what can be unfolded, and leave out what moves."""
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    page.add_style_tag(content="* { transition: none !important; animation: none !important; }")


def test_fits_every_window_in_both_schemes(open_tab):
    page = open_tab((1440, 900))
    sizes = ((1440, 900), (1280, 860), (1024, 768), (899, 700), (768, 1024), (390, 844))
    for (width, height), scheme in itertools.product(sizes, SCHEMES):
        page.set_viewport_size({"width": width, "height": height})
        show_in(page, scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        cut = "(labels) => labels.map((label) => label.scrollWidth - label.clientWidth)"
        assert page.locator(".four .q-field__label").evaluate_all(cut) == [0] * 4
        parts = {
            name: page.locator(name).first.bounding_box() for name in ("#frame img", ".strip", "[aria-label=Frame]")
        }
        run = page.get_by_role("button", name="Run", exact=True).bounding_box()
        if width >= 900:
            # Without scrolling: the picture, its slider and the button.
            assert all(box["y"] >= 0 and box["y"] + box["height"] <= height for box in (*parts.values(), run))
            assert run["x"] > parts["#frame img"]["x"] + parts["#frame img"]["width"]
        else:
            assert run["y"] > parts["[aria-label=Frame]"]["y"] > parts["#frame img"]["y"]
        image = parts["#frame img"]
        assert image["width"] / image["height"] == pytest.approx(192 / 144, rel=0.02)
        assert image["width"] > 0.4 * width


def test_everything_can_be_read_and_reached(open_tab):
    page = open_tab()
    open_all(page)
    for scheme in SCHEMES:
        show_in(page, scheme)
        assert (scheme, page.evaluate(FAINT)) == (scheme, [])
        page.mouse.click(5, 5)
        reached = []
        for _ in range(60):
            page.keyboard.press("Tab")
            reached.append(page.evaluate(FOCUS))
            if reached[-1][0] == "BODY":
                break
        stops = [stop for stop in reached if stop[0] != "BODY"]
        assert len(stops) > 30
        assert (scheme, [stop for stop in stops if not stop[1] or not stop[2]]) == (scheme, [])


def test_axe_finds_nothing_serious_in_any_window(open_tab):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page = open_tab(SIZES[-1])
    page.evaluate(axe.axe_script)
    open_another(page, "small.mkv", 8)
    press(page, "Run")
    wait_for_result(page, "64×64 pixels from 8 frames")
    press(page, "Compare widths")
    page.get_by_text("4 of 4 widths").wait_for(timeout=LONG)
    open_all(page)
    views = itertools.cycle(("Clip", "Compare", "Widths"))
    for size, scheme in itertools.product(SIZES, SCHEMES):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        show_in(page, scheme)
        for _ in range(2):
            press(page, view := next(views))
            page.get_by_role("button", name=view, exact=True, pressed=True).wait_for()
            assert (size, view, sideways(page)) == (size, view, 0)
        assert (size, scheme, view, page.evaluate(SERIOUS)) == (size, scheme, view, [])
    # A fault is found.
    page.evaluate("document.querySelector('.side').append(document.createElement('button'))")
    assert [rule for rule, _ in page.evaluate(SERIOUS)] == ["button-name"]


def test_a_finger_draws_a_region(open_tab, browser):
    with contextlib.closing(browser.new_context(has_touch=True, is_mobile=True)) as phone:
        page = open_tab(SIZES[0], phone)
        box = page.locator("#frame").bounding_box()
        touch = phone.new_cdp_session(page)
        for kind, share in (("touchStart", 0.25), ("touchMove", 0.4), ("touchMove", 0.75), ("touchEnd", None)):
            at = (
                [] if share is None else [{"x": box["x"] + share * box["width"], "y": box["y"] + share * box["height"]}]
            )
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
        page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
        sides = [int(page.get_by_label(name, exact=True).input_value()) for name in ("x", "y", "width", "height")]
        assert sides == pytest.approx([48, 36, 96, 72], abs=1)
        # The page stayed where it was, and a tap removes the region.
        assert page.evaluate("scrollY") == 0
        page.touchscreen.tap(box["x"] + 20, box["y"] + 20)
        page.wait_for_function("document.querySelector('[aria-label=x]').value === ''")
