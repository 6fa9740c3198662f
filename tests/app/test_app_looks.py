"""How the app looks: it fits every window, and everything in it can be read and reached."""

import pytest

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


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_fits_every_window_in_both_schemes(open_tab, scheme):
    page = open_tab((1440, 900), color_scheme=scheme)
    for width, height in ((1440, 900), (1280, 860), (1024, 768), (899, 700), (768, 1024), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(150)
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
        assert image["width"] / image["height"] == pytest.approx(256 / 192, rel=0.02)
        assert image["width"] > 0.4 * width


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_can_be_read_and_reached(open_tab, scheme):
    page = open_tab(color_scheme=scheme)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    page.add_style_tag(content="* { transition: none !important; }")
    page.wait_for_timeout(400)
    assert page.evaluate(FAINT) == []
    page.mouse.click(5, 5)
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(FOCUS))
        if reached[-1][0] == "BODY":
            break
    stops = [stop for stop in reached if stop[0] != "BODY"]
    assert len(stops) > 30
    assert [stop for stop in stops if not stop[1] or not stop[2]] == []
