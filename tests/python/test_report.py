"""The page of a plan in a real browser, against the manifest of the same plan."""
import io
import json
import shutil

import numpy as np
import pytest

PIL = pytest.importorskip("PIL.Image")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium")


@pytest.fixture(scope="module")
def project(viewrank, fixtures, tmp_path_factory):
    project = tmp_path_factory.mktemp("valley")
    for folder in ("sparse", "images"):
        (project / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", project, "--backend", "sgm", "--quiet")
    viewrank("report", project)
    return project


@pytest.fixture(scope="module")
def manifest(project):
    return json.loads((project / "viewrank" / "manifest.json").read_text())


@pytest.fixture(scope="module")
def page(project):
    return project / "viewrank" / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from browser import Browser

    browser = Browser(CHROMIUM, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(autouse=True)
def no_complaints(browser):
    browser.messages.clear()
    yield
    assert browser.complaints() == []


def text(browser, selector):
    """As it is read: a blank that keeps a line from breaking is a blank."""
    read = browser.script(f"(element => element.innerText ?? element.textContent)(document.querySelector({json.dumps(selector)}))")
    return read.replace("\u00a0", " ")


def colours(png, box=None):
    picture = PIL.open(io.BytesIO(png)).convert("RGB")
    return {colour for _, colour in (picture.crop(box) if box else picture).getcolors(1 << 24)}


def place(browser, selector):
    browser.script(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}}); 1")
    browser.drawn()
    x, y, width, height = browser.script(
        f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; }})()")
    return x, y, x + width, y + height


def slide(browser, cut):
    browser.script(f"(() => {{ const s = document.getElementById('slider'); s.value = {cut}; s.dispatchEvent(new Event('input', {{bubbles: true}})); }})()")
    browser.drawn()


def test_the_page_needs_nothing_else(page):
    html = page.read_text()
    assert "src=\"http" not in html and "href=\"http" not in html and "@import" not in html
    assert page.stat().st_size < 3_000_000


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("dark", [False, True])
def test_everything_is_drawn_and_nothing_juts_out(browser, page, width, dark):
    browser.open(page, width, dark=dark)
    assert browser.script("document.documentElement.scrollWidth") <= width
    for scene in ("#map", "#turn"):
        box = place(browser, scene)
        assert len(colours(browser.picture(), tuple(int(value) for value in box))) > 100, f"{scene} is empty"
    background = browser.script("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(number) for number in background[4:-1].split(",")) < 380) == dark


def test_everything_follows_the_slider(browser, page, manifest):
    browser.open(page, 1280)
    clusters, views = manifest["clusters"], len(manifest["views"])
    box = tuple(int(value) for value in place(browser, "#map"))
    pictures = []
    for cut in (1, manifest["cut"]["clusters"], len(clusters)):
        slide(browser, cut)
        pairs = sum(len(cluster["partners"]) for cluster in clusters[:cut])
        verdict = text(browser, "#verdict")
        assert f"{cut} of {views} views" in verdict and f"{pairs} image pairs" in verdict
        assert f"{100 * clusters[cut - 1]['share']:.1f} %" in verdict and f"with {cut} depth maps" in text(browser, "#curve")
        rows = text(browser, "#forecast").splitlines()
        assert any(row.split("\t")[:2] == ["depth maps", str(cut)] for row in rows)
        keys = browser.script(f"Array.from({{length: {views}}}, (_, v) => statusOf(v, state.cut)).filter(s => s === 'key').length")
        assert keys == cut
        pictures.append(PIL.open(io.BytesIO(browser.picture())).crop(box).tobytes())
    assert len(set(pictures)) == 3, "the map follows"


def test_the_states_of_the_views_are_the_manifests(browser, page, manifest):
    browser.open(page, 1280)
    shown = browser.script("names.map((name, v) => [name, statusOf(v, data.cut)])")
    assert shown == [[view["name"], view["status"]] for view in manifest["views"]]
    partners = browser.script("Array.from(ranking.keys, (key, i) => [names[key], Array.from(partnersOf(i + 1), p => names[p])])")
    assert partners == [[cluster["key"], cluster["partners"]] for cluster in manifest["clusters"]]


def test_why_a_view_is_in_and_another_is_not(browser, page, manifest):
    browser.open(page, 1280)

    def ask(name):
        browser.script(f"(() => {{ const s = document.getElementById('search'); s.value = {json.dumps(name)}; s.dispatchEvent(new Event('input')); s.focus(); }})()")
        browser.press("Enter")
        return text(browser, "#why-box")

    cut = manifest["cut"]["clusters"]
    taken, left = manifest["clusters"][2], manifest["clusters"][cut + 3]
    answer = ask(taken["key"])
    assert taken["key"] in answer and "In: it is number 3" in answer
    assert all(partner in answer for partner in taken["partners"])
    answer = ask(left["key"])
    assert "Not in" in answer and f"its turn comes at {left['rank']}" in answer and " % of what it could do by itself" in answer
    likest = browser.script("(view => [likestAt(view, state.cut).rank, likestAt(view, data.cut + 3).rank])(state.selected)")
    assert likest[0] <= cut and likest[0] <= likest[1], "a key view of this cut, not one that comes later"
    browser.script("document.querySelector('#why button').click()")
    assert "In: it is number" in text(browser, "#why-box"), "the cut moves to it"


def test_the_keyboard_reaches_everything(browser, page, manifest):
    browser.open(page, 1280)
    browser.script("document.getElementById('slider').focus()")
    before = browser.script("state.cut")
    browser.press("ArrowRight")
    assert browser.script("state.cut") == before + 1
    browser.script("document.getElementById('list').focus()")
    browser.press("ArrowDown")
    assert browser.script("names[state.selected]") == manifest["clusters"][0]["key"]
    browser.press("ArrowDown")
    assert browser.script("names[state.selected]") == manifest["clusters"][1]["key"]
    browser.script("document.getElementById('map').focus()")
    browser.press("ArrowRight")
    assert browser.script("names[state.selected]") != manifest["clusters"][1]["key"], "the next camera on the map"
    assert browser.script("names[state.selected]") in text(browser, "#under-pointer")
    browser.script("document.getElementById('turn').focus()")
    yaw = browser.script("turn.camera.yaw")
    browser.press("ArrowRight")
    assert browser.script("turn.camera.yaw") != yaw


def test_the_holes_lead_to_their_places(browser, page, manifest):
    browser.open(page, 1280)
    assert manifest["surface"]["unfulfilled"] > 0
    browser.script("document.querySelector('#holes button').click()")
    browser.drawn()
    assert browser.script("state.colour") == "reason"
    centre = browser.script("map.camera.centre")
    assert centre == pytest.approx(browser.script("data.holes[0].centre"))


def test_a_page_without_webgl(browser, page):
    browser.open(page, 1280)
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source="""
        const context = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) { return kind === 'webgl' ? null : context.call(this, kind, ...rest); };""")
    browser.open(page, 1280)
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert browser.script("map.painter.constructor.name") == "PlainPainter"
    assert len(colours(browser.picture(), tuple(int(value) for value in place(browser, "#map")))) > 100


def test_names_are_shown_as_they_are(viewrank, fixtures, browser, tmp_path):
    """A folder may be called what would be markup elsewhere."""
    project = tmp_path / "<img src=x onerror=alert(1)>&amp;"
    project.mkdir()
    (project / "sparse").symlink_to(fixtures / "valley" / "sparse")
    viewrank("plan", project, "--quiet")
    viewrank("report", project, "--quiet")
    browser.open(project / "viewrank" / "report.html", 1280)
    assert text(browser, "h1") == project.name
    assert browser.script("document.querySelectorAll('img[src=x]').length") == 0


def test_the_real_curve_stands_beside_the_predicted_one(viewrank, fixtures, browser, tmp_path):
    """Depth maps without a single depth: a real curve that stays at nothing."""
    for folder in ("sparse", "images"):
        (tmp_path / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", tmp_path, "--backend", "sgm", "--quiet")
    clusters = json.loads((tmp_path / "viewrank" / "manifest.json").read_text())["clusters"][:3]
    maps = tmp_path / "sgm" / "depth_maps"
    maps.mkdir(parents=True)
    for cluster in clusters:
        width, height = PIL.open(tmp_path / "images" / cluster["key"]).size
        np.save(maps / f"{cluster['key']}.npy", np.zeros((height, width), np.float32))
    viewrank("report", tmp_path, "--quiet")
    browser.open(tmp_path / "viewrank" / "report.html", 1280)
    assert browser.script("document.querySelectorAll('#curve .real').length") == 1
    real = browser.script("data.real")
    assert (real["maps"], real["ranks"], real["share"]) == (3, [1, 2, 3], [0, 0, 0])
    assert "3 depth maps" in text(browser, "#curve-note")
    browser.script("change({colour: 'real'})")
    browser.drawn()


def test_a_report_needs_a_plan_of_the_same_model(viewrank, fixtures, tmp_path):
    (tmp_path / "sparse").mkdir()
    shutil.copytree(fixtures / "valley" / "sparse", tmp_path / "sparse", dirs_exist_ok=True)
    assert "viewrank plan" in viewrank("report", tmp_path, expect=1).stderr
    viewrank("plan", tmp_path, "--quiet")
    viewrank("report", tmp_path, "--quiet")
    first = (tmp_path / "viewrank" / "report.html").read_bytes()
    viewrank("report", tmp_path, "--quiet")
    assert (tmp_path / "viewrank" / "report.html").read_bytes() == first, "same input, same bytes"
    viewrank("plan", tmp_path, "--quiet")
    assert (tmp_path / "viewrank" / "report.html").read_bytes() == first, "it shows this very plan"
    points = next((tmp_path / "sparse").rglob("points3D.*"))
    model = bytearray(points.read_bytes())
    # The lowest byte of the first point's x.
    model[16] ^= 1
    points.write_bytes(model)
    refused = viewrank("report", tmp_path, expect=1).stderr
    assert refused.startswith("error: ") and "have changed" in refused and "\nhint: make the plan first: viewrank plan" in refused
    assert (tmp_path / "viewrank" / "report.html").read_bytes() == first
    viewrank("plan", tmp_path, "--dry-run", "--quiet")
    assert (tmp_path / "viewrank" / "report.html").exists()
    viewrank("plan", tmp_path, "--quiet")
    assert not (tmp_path / "viewrank" / "report.html").exists(), "no page of another plan"
