"""The page of a plan in a real browser, against the manifest of the same plan."""
import base64
import io
import json
import re
import shutil

import numpy as np
import oracle
import pytest
from depths import Surface

PIL = pytest.importorskip("PIL.Image")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FIREFOX = shutil.which("firefox") or shutil.which("firefox-esr")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium")


@pytest.fixture(scope="module")
def project(viewrank, fixtures, tmp_path_factory):
    project = tmp_path_factory.mktemp("valley")
    for folder in ("sparse", "images"):
        (project / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", project, "--backend", "sgm", "--quiet", "--dump-tables", project / "tables")
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
    """Returns the visible text, with no-break spaces as spaces."""
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


def warned(manifest):
    """Warnings of the plan and its exports, and the parts that the exports do not honour."""
    of_exports = [f"{export['backend']}: {said}" for export in manifest["exports"] for said in
                  [text for text in export["warnings"] if text not in manifest["warnings"]]
                  + [f"not honoured: {what}" for what in export["not_honoured"]]]
    return manifest["warnings"] + of_exports


def test_what_backends_do_not_honour_is_on_the_page(viewrank, fixtures, browser, tmp_path):
    for folder in ("sparse", "images"):
        (tmp_path / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", tmp_path, "--backend", "odm,realityscan", "--quiet")
    viewrank("report", tmp_path)
    browser.open(tmp_path / "viewrank" / "report.html", 1280)
    manifest = json.loads((tmp_path / "viewrank" / "manifest.json").read_text())
    assert sorted(browser.script("[...data.warnings, ...data.notes]")) == sorted(warned(manifest))
    assert not any("not honoured" in warning for warning in browser.script("data.warnings")), "the box is for what can be changed"
    browser.script("document.getElementById('notes').open = true")
    assert "realityscan: not honoured: matching partners" in text(browser, "#notes")


def test_everything_follows_the_slider(browser, page, manifest):
    browser.open(page, 1280)
    clusters, views = manifest["clusters"], len(manifest["views"])
    browser.script("document.getElementById('cost').open = true")
    box = tuple(int(value) for value in place(browser, "#map"))
    pictures = []
    for cut in (1, manifest["cut"]["clusters"], len(clusters)):
        slide(browser, cut)
        pairs = sum(len(cluster["partners"]) for cluster in clusters[:cut])
        verdict = text(browser, "#verdict")
        assert f"{cut} of {views} views" in verdict and f"{pairs} image pairs" in verdict
        reached = f"{100 * clusters[cut - 1]['share']:.1f} % with {cut} depth map{'s' if cut > 1 else ''}"
        assert verdict.endswith(f"{reached.split(' with')[0]} of the area that all depth maps cover.")
        assert reached in text(browser, "#curve")
        assert reached in browser.script("document.getElementById('curve').getAttribute('aria-label')").replace("\u00a0", " ")
        numbers = text(browser, "#numbers").split("\n")
        assert [str(cut), str(pairs), reached.split(" with")[0]] == [number for number in numbers if number and not re.search("[a-z]", number)]
        rows = text(browser, "#forecast").splitlines()
        assert any(row.split("\t") == ["depth maps", str(cut), str(len(clusters))] for row in rows)
        keys = browser.script(f"Array.from({{length: {views}}}, (_, v) => statusOf(v, state.cut)).filter(s => s === 'key').length")
        assert keys == cut
        pictures.append(PIL.open(io.BytesIO(browser.picture())).crop(box).tobytes())
    assert len(set(pictures)) == 3, "the map follows"
    slide(browser, 0)
    assert text(browser, "#worth") == "", "nothing is as fast as nothing"


def test_the_states_of_the_views_are_the_manifests(browser, page, manifest):
    browser.open(page, 1280)
    shown = browser.script("names.map((name, v) => [name, statusOf(v, data.cut)])")
    assert shown == [[view["name"], view["status"]] for view in manifest["views"]]
    partners = browser.script("Array.from(ranking.keys, (key, i) => [names[key], Array.from(partnersOf(i + 1), p => names[p])])")
    assert partners == [[cluster["key"], cluster["partners"]] for cluster in manifest["clusters"]]


def likest(project, rank, cut):
    """Returns rank (from 1) and share of the best substitute of a cluster within the cut, the first one in a tie."""
    tables = oracle.Tables(project / "tables")
    own = tables.fulfilment_of(tables.order[rank])
    shares = []
    for cluster in tables.order[:cut]:
        other = tables.fulfilment_of(cluster)
        shares.append(sum(min(f, own[t]) for t, f in other.items() if t in own) / sum(own.values()))
    return [int(np.argmax(shares)) + 1, max(shares)]


def test_why_a_view_is_in_and_another_is_not(browser, page, manifest, project):
    browser.open(page, 1280)

    def ask(name):
        browser.script(f"(() => {{ const s = document.getElementById('search'); s.value = {json.dumps(name)}; s.dispatchEvent(new Event('input')); s.focus(); }})()")
        browser.press("Enter")
        return text(browser, "#why-box")

    cut = manifest["cut"]["clusters"]
    taken, left = manifest["clusters"][2], manifest["clusters"][cut + 3]
    answer = ask(taken["key"])
    assert taken["key"] in answer and "Chosen: rank 3 of" in answer
    assert all(partner in answer for partner in taken["partners"])
    answer = ask(left["key"])
    assert "Not chosen" in answer and f"its rank is {left['rank']}" in answer and " % of what it could do by itself" in answer
    shown = browser.script("(view => { const { rank, share } = substituteAt(view, state.cut); return [rank, share]; })(state.selected)")
    assert shown == pytest.approx(likest(project, left["rank"] - 1, cut), abs=1e-6)
    browser.script("document.querySelector('#why button').click()")
    assert "Chosen: rank" in text(browser, "#why-box"), "the cut moves to it"


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
    centre = browser.script("map.camera.centre")
    browser.press("ArrowRight", shift=True)
    moved = browser.script("map.camera.centre")
    assert moved[0] > centre[0] and moved[1:] == pytest.approx(centre[1:]), "the map itself"
    browser.script("document.getElementById('turn').focus()")
    yaw = browser.script("turn.camera.yaw")
    browser.press("ArrowRight")
    assert browser.script("turn.camera.yaw") != yaw


def test_what_is_read_out(browser, page, manifest):
    """A screen reader announces the verdict while the slider moves, and the reason of a view when it is selected."""
    browser.open(page, 1280)
    rows = browser.script("Array.from(document.querySelectorAll('#list .row'), row => [row.getAttribute('aria-posinset'), row.getAttribute('aria-setsize')])")
    assert rows and rows == [[str(i + 1), str(len(manifest["views"]))] for i in range(len(rows))]
    live = "document.getElementById('why-box').getAttribute('aria-live')"
    browser.script("change({ selected: 3 })")
    assert browser.script(live) == "polite"
    slide(browser, 2)
    assert browser.script(live) == "off"


def test_numbers_in_few_words(browser, page):
    browser.open(page, 1280)
    words = {0: "0", 1: "1", 9999.4: "9,999", 9999.6: "10.0 k", 123456: "123 k", 999499: "999 k", 999999: "1.00 M", 1234567: "1.23 M", 999999999: "1.00 G"}
    for number, expected in words.items():
        assert browser.script(f"short({number})") == expected
    assert browser.script("[percent(-0.00001), percent(-0, 0), percent(-0.01)]") == ["0.0\u00a0%", "0\u00a0%", "-1.0\u00a0%"]


def colour_blind(colour):
    """L*a*b* of what people without green cones see (Machado, Oliveira and Fernandes 2009)."""
    value = np.array(colour) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]) @ linear, 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen / [0.9505, 1, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_colours_are_told_apart_by_colour_blind_people(browser, page):
    browser.open(page, 1280)
    for colours in (browser.script("data.ramp"), browser.script("[0, 4, 6, 7, 8].map(i => REASON_COLOURS[i])"), browser.script("MAP_COLOURS")):
        places = [colour_blind(colour) for colour in colours]
        light = sorted(place[0] for place in places)
        assert all(b - a > 9 for a, b in zip(light, light[1:])), f"{colours} hold in greyscale"
        for i, one in enumerate(places):
            assert all(np.linalg.norm(one - other) > 30 for other in places[:i]), colours
    reasons = browser.script("[...new Set(surface.reason)]")
    assert set(reasons) <= {0, 4, 6, 7, 8}, "no other reason is one of a place"


def test_it_prints_decently(browser, page, manifest):
    browser.open(page, 1280)
    pdf = base64.b64decode(browser.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69)["data"])
    assert pdf.startswith(b"%PDF-") and len(re.findall(rb"/Type\s*/Page\b(?!s)", pdf)) == 2
    browser.call("Emulation.setEmulatedMedia", media="print")
    rows = browser.script("Array.from(document.querySelectorAll('#print-list tr'), row => row.children[3].textContent)")
    assert rows[1:] == [cluster["key"] for cluster in manifest["clusters"][:manifest["cut"]["clusters"]]]
    shown = {name: browser.script(f"getComputedStyle(document.querySelector('{name}')).display !== 'none'")
             for name in ("#print-list", "#verdict", "#map", "#slider-row", "#list", "#search")}
    assert shown == {"#print-list": True, "#verdict": True, "#map": True, "#slider-row": False, "#list": False, "#search": False}


def test_the_holes_lead_to_their_places(browser, page, manifest):
    browser.open(page, 1280)
    assert manifest["surface"]["unfulfilled"] > 0
    numbers = "(() => { const said = []; const fill = map.context.fillText; map.context.fillText = text => said.push(text); map.drawHoles(); map.context.fillText = fill; return said; })()"
    assert browser.script(numbers)[:5] == [1, 2, 3, 4, 5][:browser.script("data.holes.length")]
    browser.script("document.querySelector('#holes button').click()")
    browser.drawn()
    assert browser.script("state.colour") == "reason"
    centre = browser.script("map.camera.centre")
    assert centre == pytest.approx(browser.script("data.holes[0].centre"))


def test_no_place_to_fly_to_is_in_the_background(viewrank, data, tmp_path):
    """The hull of `lewis` extends far beyond its subject."""
    pycolmap = pytest.importorskip("pycolmap")
    for folder in ("sparse", "images"):
        (tmp_path / folder).symlink_to(data("lewis") / folder)
    viewrank("plan", tmp_path, "--quiet")
    viewrank("report", tmp_path)
    page = (tmp_path / "viewrank" / "report.html").read_text()
    shown = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    model = pycolmap.Reconstruction(next((tmp_path / "sparse").glob("**/images.*")).parent)
    centre = {number: image.projection_center() for number, image in model.images.items()}
    usual = np.median([min(np.linalg.norm(centre[e.image_id] - point.xyz) for e in point.track.elements) for point in model.points3D.values()])
    assert 0 < shown["far_area"] < shown["holes_area"] < shown["area"]
    cameras = np.frombuffer(base64.b64decode(shown["views"]["centres"]), "<f4").reshape(-1, 3)
    listed = [np.linalg.norm(cameras - hole["centre"], axis=1).min() for hole in shown["holes"]]
    assert 0 < max(listed) < 4.5 * usual, "the middle of a place may lie a little farther than its parts"


def test_the_address_keeps_the_state(browser, page):
    """A reload, also after a new plan, restores the view."""
    browser.open(page, 1280)
    assert text(browser, "#stale") and not browser.script("document.getElementById('stale').offsetHeight")
    browser.script("change({ cut: 2, selected: 5, colour: 'count' })")
    kept = "[state.cut, state.selected, state.colour]"
    assert browser.script(kept) == [2, 5, "count"]
    address = browser.script("location.href")
    for url in ("about:blank", address):
        browser.call("Page.navigate", url=url)
        browser.script("new Promise(done => { const wait = () => document.readyState === 'complete' ? done(1) : setTimeout(wait, 20); wait(); })")
    browser.drawn()
    assert browser.script(kept) == [2, 5, "count"]


def test_a_hole_is_labelled_where_it_is_and_says_what_to_fly(browser, page, project):
    browser.open(page, 1280)
    holes, flight = browser.script("data.holes"), browser.script("[Array.from(flight.centres), Array.from(flight.directions), data.flight]")
    low, high = (browser.script(f"data.subject.{end}") for end in ("low", "high"))
    centroids = np.array(browser.script("Array.from({length: surface.count}, (_, t) => [0, 1, 2].map(i => [0, 1, 2].reduce((s, c) => s + surface.vertices[3 * surface.triangles[3 * t + c] + i], 0) / 3))"))
    open_ones = centroids[np.array(browser.script("Array.from(surface.reason)")) > 0]
    for hole in holes:
        assert np.linalg.norm(open_ones - hole["centre"], axis=1).min() < 1e-4, "on the hole, also where it is a ring"
        assert all(a <= x <= b for a, x, b in zip(low, hole["centre"], high)), "within the subject"
        assert hole["missing"] and hole["advice"]
    centres, directions = (np.reshape(values, (-1, 3)) for values in flight[:2])
    assert len(centres) == len(flight[2]["holes"]) and all(0 <= part <= 1 for part in flight[2]["of_holes"])
    vertices = np.reshape(browser.script("Array.from(surface.vertices)"), (-1, 3))
    for centre, direction, hole in zip(centres, directions, flight[2]["holes"]):
        distance = np.linalg.norm(centroids - centre, axis=1)
        ahead = (centroids - centre) @ direction / distance
        looked_at = distance[ahead > 0.99].min()
        assert np.linalg.norm(vertices - centre, axis=1).min() > 0.4 * looked_at, "at a safe distance"
        assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-5) and hole < len(holes)
    folder = project / "viewrank" / "flight"
    assert len(centres) == 0 or sorted(file.name for file in folder.iterdir()) == ["waypoints.ply", "waypoints_local.json"]


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
    """The name of a folder may contain markup."""
    project = tmp_path / "<img src=x onerror=alert(1)>&amp;"
    project.mkdir()
    (project / "sparse").symlink_to(fixtures / "valley" / "sparse")
    (project / "images").mkdir()
    for registered in (fixtures / "valley" / "images").iterdir():
        (project / "images" / registered.name).symlink_to(registered)
    for number in range(210):
        (project / "images" / f"late{number:03}.jpg").touch()
    viewrank("plan", project, "--quiet")
    viewrank("report", project, "--quiet")
    browser.open(project / "viewrank" / "report.html", 1280)
    assert text(browser, "h1") == project.name
    assert "210 images without a pose" in text(browser, "#facts")
    browser.script("(() => { const s = document.getElementById('search'); s.value = 'late209'; s.dispatchEvent(new Event('input')); })()")
    assert text(browser, "#list").startswith("late209.jpg has no pose")
    manifest = json.loads((project / "viewrank" / "manifest.json").read_text())
    assert browser.script("[...data.warnings, ...data.notes]") == warned(manifest)
    assert browser.script("document.querySelectorAll('img[src=x]').length") == 0


@pytest.fixture(scope="module")
def measured(viewrank, fixtures, tmp_path_factory):
    """A planned project, and a function that writes depth maps of the plan's own surface for ranks of its first ranking, scaled by a factor."""
    project = tmp_path_factory.mktemp("measured")
    for folder in ("sparse", "images"):
        (project / folder).symlink_to(fixtures / "valley" / folder)
    (project / "viewrank.toml").write_text("image_scale = 0.25\n")
    viewrank("plan", project, "--backend", "sgm", "--quiet")
    model, surface = oracle.Model(fixtures / "valley" / "sparse" / "0"), Surface(project)
    manifest = json.loads((project / "viewrank" / "manifest.json").read_text())
    views = {view["name"]: i for i, view in enumerate(model.views)}
    maps = project / "sgm" / "depth_maps"

    def write(ranks, factor=1, maps=maps):
        shutil.rmtree(maps, ignore_errors=True)
        maps.mkdir(parents=True)
        for rank in ranks:
            key = manifest["clusters"][rank - 1]["key"]
            camera = model.cameras[model.views[views[key]]["camera"]]
            width, height = camera["width"] // 4, camera["height"] // 4
            np.save(maps / f"{key}.npy", factor * surface.depths(model, views[key], width, height))
        return maps

    return project, manifest, write


def reported(viewrank, browser, project, *options):
    viewrank("report", project, "--quiet", *options)
    browser.open(project / "viewrank" / "report.html", 1280)
    return browser.script("data.real")


@pytest.mark.parametrize(("factor", "least", "most"), [(1, 0.75, 1.6), (1.3, 0, 0.25), (0, 0, 0)], ids=["right", "of a wrong scale", "empty"])
def test_the_real_curve_stands_beside_the_predicted_one(viewrank, browser, measured, tmp_path, factor, least, most):
    """With true depths as reference, right maps reach the prediction; maps of a wrong scale reach what they share with thumbnails by chance, empty ones nothing."""
    project, manifest, write = measured
    ranks = [1, 2, 4]
    write(ranks, factor)
    real = reported(viewrank, browser, project, "--reference", write(ranks, maps=tmp_path / "true"))
    assert browser.script("document.querySelectorAll('#curve .real').length") == 1
    assert (real["maps"], real["ranks"]) == (3, [1, 2, 4])
    predicted = manifest["clusters"][1]["share"]
    assert least * predicted <= real["share"][1] <= most * predicted, "with the first two of the ranking"
    assert "3 depth maps" in text(browser, "#curve-note") and "against the reference" in text(browser, "#curve-note")
    browser.script("change({colour: 'real'})")
    browser.drawn()


def test_the_page_begins_with_what_was_computed_and_measured(viewrank, browser, measured):
    """As after a run that reached its target before the end of the list."""
    project, manifest, write = measured
    write([1, 2])
    real = reported(viewrank, browser, project)
    assert manifest["cut"]["clusters"] > 2 and browser.script("state.cut") == 2
    share = f"{100 * real['share'][1]:.1f} %"
    assert text(browser, "#verdict").startswith("2 of 28 views have a depth map") and f"about {share}" in text(browser, "#verdict")
    assert f"{share} with 2 depth maps" in text(browser, "#curve")
    write([])


def test_a_page_of_images_has_the_words_of_images(viewrank, fixtures, browser, tmp_path):
    for folder in ("sparse", "images"):
        (tmp_path / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", tmp_path, "--backend", "splat", "--budget", "10", "--report", "--quiet")
    browser.open(tmp_path / "viewrank" / "report.html", 1280)
    assert text(browser, "#verdict").startswith("10 of 28 images:")
    for cut in (10, 0, 28):
        slide(browser, cut)
        browser.script(f"change({{ selected: {cut} - 1 }})")
        said = text(browser, "body").lower()
        assert not [word for word in ("depth map", "key view", "cluster", "partner", "hole", "image pair") if re.search(rf"\b{word}", said)]
    assert not (tmp_path / "viewrank/flight").exists()


def test_depth_maps_that_cannot_be_read_are_named_and_the_others_shown(viewrank, browser, measured):
    project, manifest, write = measured
    maps = write([1, 2, 3])
    broken = maps / f"{manifest['clusters'][1]['key']}.npy"
    broken.write_bytes(broken.read_bytes()[:1000])
    real = reported(viewrank, browser, project)
    assert (real["maps"], real["ranks"]) == (2, [1, 3])
    assert broken.name in text(browser, "#warnings")
    for path in maps.iterdir():
        path.write_bytes(b"")
    assert reported(viewrank, browser, project) is None
    assert "cannot show the depth maps in" in text(browser, "#warnings")
    write([])
    assert reported(viewrank, browser, project) is None
    assert browser.script("data.warnings") == warned(manifest), "an empty folder is no fault"
    refused = viewrank("report", project, "--reference", project / "nowhere", expect=2)
    assert "nowhere" in refused.stderr
    refused = viewrank("report", project, "--reference", write([1]), "--depth-maps", project / "images", expect=1)
    assert "no depth maps" in refused.stderr


def test_a_plan_around_finished_depth_maps_is_the_one_that_is_shown(viewrank, browser, measured):
    project, first, write = measured
    cut = first["cut"]["clusters"]
    # Those that the prediction puts last, which really bring something.
    ranks = [cut + 1, cut + 2, len(first["clusters"])]
    viewrank("plan", project, "--backend", "sgm", "--quiet", "--finished", write(ranks))
    manifest = json.loads((project / "viewrank" / "manifest.json").read_text())
    keys = [cluster["key"] for cluster in manifest["clusters"]]
    assert keys != [cluster["key"] for cluster in first["clusters"]] and sum(cluster["finished"] for cluster in manifest["clusters"]) == 3
    reported(viewrank, browser, project)
    assert browser.script("Array.from(ranking.keys, key => names[key])") == keys
    assert browser.script("data.cut") == manifest["cut"]["clusters"]
    assert browser.script("names.map((name, v) => [name, statusOf(v, data.cut)])") == [[view["name"], view["status"]] for view in manifest["views"]]
    assert browser.script("Array.from(ranking.shares)") == pytest.approx([cluster["share"] for cluster in manifest["clusters"]])
    assert browser.script("Array.from(ranking.keys, (key, i) => Array.from(partnersOf(i + 1), p => names[p]))") == [
        cluster["partners"] for cluster in manifest["clusters"]]
    assert "Ranked around 3 finished depth maps" in text(browser, "#curve-note")
    # What has its depth map is matched already.
    browser.script("document.getElementById('cost').open = true; change({ perPair: 0, perMap: 60 })")
    row = next(row.split("\t") for row in text(browser, "#forecast").splitlines() if row.startswith("time"))
    cut = manifest["cut"]["clusters"]
    assert row[1:] == [browser.script(f"duration({60 * (count - 3)})") for count in (cut, len(keys))]
    left = manifest["forecast"]["all_maps"] - 3
    faster = left / (cut - 3)
    assert f"{faster:.1f} times faster" in text(browser, "#worth") and f"each of the {left} views" in text(browser, "#worth")
    for rank, words in ((1, "Chosen: its depth map is finished"), (4, "Chosen: rank 4 of")):
        browser.script(f"change({{ selected: ranking.keys[{rank - 1}] }})")
        assert words in text(browser, "#why-box")


def test_depth_maps_at_half_size_are_shown(viewrank, fixtures, browser, tmp_path):
    for folder in ("sparse", "images"):
        (tmp_path / folder).symlink_to(fixtures / "valley" / folder)
    viewrank("plan", tmp_path, "--backend", "sgm", "--scales", "1,0.5", "--quiet")
    viewrank("report", tmp_path)
    plan = json.loads((tmp_path / "viewrank" / "manifest.json").read_text())
    clusters, cut = plan["clusters"], plan["cut"]["clusters"]
    half = [cluster["scale"] == 0.5 for cluster in clusters]
    assert any(half) and not all(half)
    browser.open(tmp_path / "viewrank" / "report.html", 1280)
    assert browser.script("Array.from(ranking.keys, (key, i) => isHalf(i + 1))") == half
    assert browser.script("Array.from(ranking.work)") == pytest.approx([cluster["work"] for cluster in clusters])
    halves = sum(half[:cut])
    assert f"{cut - halves} at full and {halves} at half size" in text(browser, "#numbers")
    assert f"{100 * clusters[cut - 1]['work']:.0f} %" in text(browser, "#numbers")
    rank = half.index(True) + 1
    browser.script(f"change({{ cut: {len(clusters)}, selected: ranking.keys[{rank - 1}] }})")
    assert "key view, half size" in text(browser, "#why-box") and "key view at half size" in text(browser, "#map-box .legend")


@pytest.mark.skipif(FIREFOX is None, reason="no firefox")
def test_the_page_in_firefox(page, manifest, tmp_path):
    from firefox import Firefox

    firefox = Firefox(FIREFOX, tmp_path)
    try:
        for width in (1280, 400):
            firefox.open(page, width)
            assert firefox.script("document.documentElement.scrollWidth") <= width
            for scene in ("#map", "#turn"):
                box = tuple(int(value) for value in place(firefox, scene))
                assert len(colours(firefox.picture(), box)) > 100, f"{scene} is empty"
        slide(firefox, 2)
        assert f"{100 * manifest['clusters'][1]['share']:.1f} %" in text(firefox, "#verdict")
        firefox.script("change({ selected: ranking.keys[0] })")
        assert "Chosen: rank 1 of 2" in text(firefox, "#why-box")
        assert firefox.complaints == []
    finally:
        firefox.close()


def many(data, copies):
    """The page's data of a plan, repeated side by side; the surface of the first twenty copies."""
    def read(text, kind):
        return np.frombuffer(base64.b64decode(text), kind)

    def written(values, kind):
        return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()

    def repeated(part, names, copies, change=lambda values, copy: values):
        for name, kind in names.items():
            part[name] = written(np.concatenate([change(read(part[name], kind), copy) for copy in range(copies)]), kind)

    def places(values, copy):
        return (values.reshape(-1, 3) + [60 * (copy % 14), 60 * (copy // 14), 0]).ravel()

    def behind(offsets, copies):
        lengths = np.tile(np.diff(read(offsets, "<u4")), copies)
        return written(np.concatenate([[0], np.cumsum(lengths)]), "<u4")

    def ranks(values, copy):
        """Copies of a rank are consecutive; 0 and the largest u16 mean none."""
        return np.where((values == 0) | (values == 0xffff), values, (values.astype(int) - 1) * copies + copy + 1)

    views, ranking, surface = data["views"], data["ranking"], data["surface"]
    count, vertices = len(views["names"]), len(read(surface["vertices"], "<f4")) // 3
    names = views["names"]
    views["names"] = [f"{copy:03} {name}" for copy in range(copies) for name in names]
    repeated(views, {"centres": "<f4", "footprints": "<f4"}, copies, places)
    repeated(views, {"directions": "<f4", "reason": "u1", "seen": "<u4", "likest_shares": "<f4"}, copies)
    repeated(views, {"rank": "<u4", "likest": "<u4"}, copies, ranks)
    for name in ("footprint_offsets", "likest_offsets"):
        views[name] = behind(views[name], copies)
    starts, partners = read(ranking["partner_offsets"], "<u4"), read(ranking["partners"], "<u4")
    lists = [partners[a:b] + count * copy for a, b in zip(starts, starts[1:]) for copy in range(copies)]
    ranking["partners"] = written(np.concatenate(lists), "<u4")
    ranking["partner_offsets"] = written(np.cumsum([0, *map(len, lists)]), "<u4")
    ranking["keys"] = written([key + count * copy for key in read(ranking["keys"], "<u4") for copy in range(copies)], "<u4")
    gains = np.repeat(read(ranking["gains"], "<f8"), copies) / copies
    ranking["gains"], ranking["shares"] = written(gains, "<f8"), written(np.cumsum(gains) / gains.sum(), "<f8")
    ranking["points"] = written(np.repeat(read(ranking["points"], "<f8"), copies), "<f8")
    shown = 20
    repeated(surface, {"vertices": "<f4"}, shown, places)
    repeated(surface, {"triangles": "<u4"}, shown, lambda values, copy: values + vertices * copy)
    repeated(surface, {"shares": "u1", "reachable": "u1", "reason": "u1"}, shown)
    repeated(surface, {"ranks": "<u2", "first": "<u2"}, shown, ranks)
    surface["offsets"] = behind(surface["offsets"], shown)
    for name in ("cut", "clusters_total", "pairs_total"):
        data[name] *= copies
    data["thumbnails"] = dict(zip(map(str, range(data["most_thumbnails"])), 18 * list(data["thumbnails"].values())))


def test_a_page_of_five_thousand_views(browser, page, tmp_path):
    html = page.read_text()
    before, rest = html.split('<script id="data" type="application/json">')
    text_of_data, after = rest.split("</script>", 1)
    data = json.loads(text_of_data)
    many(data, 180)
    large = tmp_path / "large.html"
    large.write_text(f'{before}<script id="data" type="application/json">{json.dumps(data)}</script>{after}')
    assert large.stat().st_size < 8_000_000
    browser.open(large, 1280)
    assert text(browser, "#facts").startswith("5,040 views") and "the first 500 " in text(browser, "footer")
    rows = "document.querySelectorAll('#list .row').length"
    assert 0 < browser.script(rows) < 40, "only those in sight"
    assert len(colours(browser.picture(), tuple(int(value) for value in place(browser, "#map")))) > 100
    for cut in (1, browser.script("clusters")):
        slide(browser, cut)
        assert text(browser, "#verdict").startswith(f"{cut:,} of 5,040 views") and browser.script(rows) < 40
    browser.script("change({ selected: inOrder[4000] })")
    browser.drawn()
    assert browser.script("document.querySelector('#list .row.on').getAttribute('aria-posinset')") == "4001"
    chosen = browser.script("statusOf(inOrder[4000], state.cut)")
    assert chosen == "key" and "Chosen: rank 4001" in text(browser, "#why-box")


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
    assert refused.startswith("error: ") and "has changed" in refused and "\nhint: plan again: viewrank plan" in refused
    assert (tmp_path / "viewrank" / "report.html").read_bytes() == first
    viewrank("plan", tmp_path, "--dry-run", "--quiet")
    assert (tmp_path / "viewrank" / "report.html").exists()
    viewrank("plan", tmp_path, "--quiet")
    stale = (tmp_path / "viewrank" / "report.html").read_bytes()
    assert stale == first.replace(b'<html lang="en">', b'<html lang="en" data-stale>', 1) != first, "an open page survives a reload, and says that it is old"


def test_a_plan_with_its_page_has_the_page_of_report(viewrank, fixtures, tmp_path):
    project = tmp_path / "valley"
    shutil.copytree(fixtures / "valley", project, ignore=shutil.ignore_patterns("viewrank"))
    done = viewrank("plan", project, "--backend", "sgm", "--report")
    page = project / "viewrank/report.html"
    assert str(page) in done.stdout and "viewrank report" not in done.stdout, "the page is there"
    files = [page, *sorted((project / "viewrank/flight").iterdir())]
    before = [file.read_bytes() for file in files]
    viewrank("report", project)
    assert [file.read_bytes() for file in files] == before
    viewrank("plan", project, "--backend", "sgm", "--target", "60%", "--quiet")
    assert [file.read_bytes() for file in files[1:]] == before[1:] and page.exists(), "the flight of the old page stays with it"


def test_a_report_keeps_what_it_had_to_compute_again(viewrank, fixtures, tmp_path):
    project = tmp_path / "valley"
    shutil.copytree(fixtures / "valley", project, ignore=shutil.ignore_patterns("viewrank"))
    viewrank("plan", project, "--backend", "sgm", "--quiet")
    cache = project / "viewrank/cache"
    tables = {file.name: file.read_bytes() for file in cache.iterdir()}
    shutil.rmtree(cache)
    viewrank("report", project, "--threads", "1", "--quiet")
    assert {file.name: file.read_bytes() for file in cache.iterdir()} == tables != {}


def test_holes_on_a_regions_border_count_what_is_inside(viewrank, fixtures, tmp_path):
    shutil.copytree(fixtures / "valley", tmp_path / "p")
    region = tmp_path / "region.geojson"
    region.write_text('{"type": "Polygon", "crs": null, "coordinates": [[[-1.5, -1.5], [1.5, -1.5], [1.5, 1.5], [-1.5, 1.5], [-1.5, -1.5]]]}')
    # Too fine for all but some places, so that holes are most of the region.
    viewrank("plan", tmp_path / "p", "--backend", "sgm", "--region", region, "--gsd", "0.005", "--report", "--quiet")
    page = (tmp_path / "p/viewrank/report.html").read_text()
    shown = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    listed = sum(hole["area"] for hole in shown["holes"] if hole["triangles"])
    assert 0.5 * shown["holes_area"] < listed <= shown["holes_area"]
