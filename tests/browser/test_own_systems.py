"""A registered system without a scene in Chromium: its signals stand in the scene's place."""

import importlib

import pytest
from playwright.sync_api import expect

import pemviz
from tests.browser.driving import fits, on_the_page, until
from tests.own_systems import BLIND, DRONE, PEMS, RULES, register


@pytest.fixture
def own_runs(panel, tmp_path, monkeypatch):
    """Runs of registered systems among the panel's."""
    register(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")
    importlib.invalidate_caches()
    for name, pem in PEMS.items():
        config = pemviz.ExperimentConfig(
            simulator=name, method="naive", spec=RULES[name], final_rollouts=60, plan=False
        )
        pemviz.record(pemviz.build_experiment(config, pem=pem), panel.root / name)


PLACES = """() => {
  const all = (what) => [...document.querySelectorAll(what)];
  const box = (one) => {
    const { x, y, width, height } = one.getBoundingClientRect();
    return { x, y, width, height };
  };
  const [look, line, values] = [".look", ".timeline", ".values"].map((what) => all(what)[0]);
  return {
    room: look.clientWidth - 20,
    drawn: all(".signals svg").map((one) => one.viewBox.baseVal.width),
    charts: all(".signals .chart").map(box),
    cursors: all(".signals b").map((one) => box(one).x + 1),
    line: box(line),
    share: Number(values.dataset.step) / Number(line.getAttribute("aria-valuemax")),
  };
}"""


def shown(page, signals):
    """Whether all signals are drawn as wide as there is room, apart, their cursors on the step."""
    found = page.evaluate(PLACES)
    charts, line = found["charts"], found["line"]
    at = line["x"] + line["width"] * found["share"]
    ends = [box["y"] + box["height"] for box in charts]
    return (
        len(charts) == len(found["drawn"]) == signals
        and all(abs(width - found["room"]) < 2 for width in found["drawn"])
        and all(box["height"] >= 110 and box["width"] <= found["room"] + 1 for box in charts)
        and all(end <= box["y"] + 0.5 for end, box in zip(ends, charts[1:], strict=False))
        and all(abs(cursor - at) < 3 for cursor in found["cursors"])
    )


@pytest.mark.usefixtures("own_runs")
@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize(("name", "signals"), [(DRONE, 2), (BLIND, 7)])
def test_signals_stand_in_the_place_of_a_scene(open_page, shots, name, signals, theme):
    page = open_page(f"run/{name}?among=all&first=least+robust")
    if theme == "dark":
        page.keyboard.press("d")
    assert page.locator("iframe").count() == 0
    for width, height in ((1280, 720), (1000, 700)):
        page.set_viewport_size({"width": width, "height": height})
        until(page, lambda: shown(page, signals))
        page.keyboard.press("Shift+ArrowLeft")
        until(page, lambda: shown(page, signals))
        assert fits(page)
        for part in (page.locator(".timeline"), page.get_by_role("button", name="Play")):
            assert on_the_page(page, part)
        page.screenshot(path=shots / f"own-{name}-{theme}-{width}.png")


@pytest.mark.usefixtures("own_runs")
def test_keys_and_misses_move_the_signals_cursor(open_page):
    page = open_page(f"run/{DRONE}?among=all&first=least+robust&step=0")
    values = page.locator(".values")
    expect(values).to_have_attribute("data-step", "0")
    expect(values).to_contain_text("distance 2.00 m, approach 0.00 m/s")
    page.keyboard.press("m")
    expect(values).to_contain_text("MISSED")
    at = int(values.get_attribute("data-step"))
    page.keyboard.press("ArrowRight")
    expect(values).to_have_attribute("data-step", str(at + 1))
    until(page, lambda: shown(page, 2))
    page.get_by_role("button", name="Play").click()
    until(page, lambda: int(values.get_attribute("data-step")) > at + 3)
    expect(page.get_by_role("button", name="3D page")).to_have_count(0)
    expect(page.get_by_text("view: ")).to_have_count(0)
