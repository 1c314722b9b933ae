#!/usr/bin/env python3
"""Tests the page that trains in a browser tab, in headless Chromium.

    python3 tests/web.py PAGE FLOTILLA [FOLDER]

PAGE is the index.html that web/build writes, and FLOTILLA the program. Screenshots are written to FOLDER. Needs
Python's standard library and Chromium. With FLOTILLA_LONG=1, it also saves videos, and looks at the page with forced
colours, when zoomed, and at three sizes.

- Training on the CPU and with WebGPU (SwiftShader) must give the program's digests. Verify must detect a missing pass.
- Training can be paused and scrubbed, maps can be rearranged, and leaders can be driven.
- Configs, runs and links can be opened and saved. The program must accept the saved files. Broken files are reported.
- The page must report no errors, and stay responsive. Its contrasts must meet WCAG AA in light and dark mode.
"""

import difflib
import http.server
import itertools
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import threading
import time
import zipfile

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from replay import COLOURS, Browser, contrast

LONG = os.environ.get("FLOTILLA_LONG") == "1"
CONFIGS = pathlib.Path(__file__).parent.parent / "configs"
WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"]
SMALL = {"trials": 2, "generations": 6, "population": 20, "seed": 7}
READY = "document.body.dataset.ready !== undefined"
STAGED = """
[world]
leaders = [[5, 5]]
followers = [[4, 4], [6, 4]]
pois = [[5, 12], [12, 5]]
coupling = 2
[learning]
population = 12
generations = 5
trials = 2
[[stages]]
from = 3
set = { world.pois = [[40, 30]], world.coupling = 1, learning.poi_jitter = 1.0 }
"""
# Agents and POIs in regions. Of the sheep, every second one is drawn.
REGIONS = """
[world]
map = [40.0, 40.0]
steps = 5
[[agents]]
name = "dog"
at = [[15.0, 20.0], [25.0, 20.0]]
senses = [{ of = "pois" }]
leads = "sheep"
[[agents]]
name = "sheep"
count = 2500
in = { disc = [20.0, 20.0, 8.0] }
control = "follow"
motion = { kind = "steered", max_speed = 1.0 }
rule = [{ of = "dog", to = 20.0, gain = 1.0 }]
[[pois]]
name = "gate"
at = [[20.0, 30.0]]
coupling = 2000
radius = 15.0
[[pois]]
name = "den"
count = 2
in = { box = [5.0, 5.0, 35.0, 12.0] }
coupling = 3
[learning]
population = 2
generations = 2
trials = 1
"""
# A class whose policies choose among the agents of another.
CHOOSING = """
world = { map = [50, 50], steps = 10, dt = 1.0, pois = [[1, 1]], coupling = 1 }
[[agents]]
name = "scout"
at = [[25, 25]]
control = "choose:post"
motion = { kind = "free", max_speed = 1 }
senses = [{ of = "pois" }]
[[agents]]
name = "post"
at = [[15, 25], [25, 35], [35, 25]]
control = "still"
"""
# The start counts at the first POI, and the last step alone at the second. The fitness of all is of no use.
MOMENTS = """
world = { map = [30, 30], steps = 4, dt = 1.0, start_counts = true }
[[agents]]
name = "scout"
at = [[10, 10], [12, 10]]
motion = { kind = "free", max_speed = 0.5 }
senses = [{ of = "pois" }]
fitness = "D"
[[pois]]
name = "first"
at = [[10, 10]]
coupling = 1
[[pois]]
name = "last"
at = [[12, 11]]
coupling = 2
radius = 6
when = "end"
[learning]
fitness = "G"
"""
# Agents and POIs have numbers in other keys.
NUMBERED = """
[world]
leaders = [[5, 5], [6, 6]]
followers = [[7, 7], [8, 8]]
heading = [0.0, 1.0, 2.0, 3.0]
pois = [[1, 1], [20, 20], [30, 30]]
coupling = 1
"""
# The comparison of arms (`found`) is shown last, and moves what is below it.
DONE = (
    "page.state.training && page.state.training.state === 'done' && document.querySelectorAll('.sha').length > 0"
    " && page.state.training.found"
)


class Tab(Browser):
    def load(self, page, **settings):
        self.open(page.as_uri() + "#" + "&".join(f"{key}={value}" for key, value in settings.items()))
        self.wait(READY)

    def assert_no_errors(self):
        complaints = list(self.complaints())
        assert not complaints, complaints
        trouble = self.evaluate("document.querySelector('#trouble').textContent")
        assert not trouble, trouble

    def text(self, selector):
        return self.evaluate(f"document.querySelector('{selector}').textContent")

    def set(self, selector, value):
        self.evaluate(
            f"(() => {{ const e = document.querySelector('{selector}'); e.value = {json.dumps(value)};"
            " e.dispatchEvent(new Event('input', { bubbles: true }));"
            " e.dispatchEvent(new Event('change', { bubbles: true })); })()"
        )

    def click(self, selector):
        self.evaluate(
            f"(() => {{ const e = document.querySelector('{selector}'); e.scrollIntoView({{ block: 'center' }});"
            f" window.clicked = false; const note = event => {{ window.clicked ||= !!event.target.closest('{selector}'); }};"
            " removeEventListener('click', window.noted, true); window.noted = note; addEventListener('click', note, true); })()"
        )
        # New results may move or replace the element before the click. Try again if it was missed.
        for _ in range(3):
            super().click(selector)
            if self.evaluate("window.clicked"):
                return

    def drop(self, name, content):
        self.drop_all({name: content})

    def drop_all(self, files):
        """Drops files on the page, given as names and contents in base64."""
        self.evaluate(
            "(() => { const data = new DataTransfer();"
            f" for (const [name, content] of Object.entries({json.dumps(files)}))"
            " data.items.add(new File([Uint8Array.from(atob(content), c => c.charCodeAt(0))], name));"
            " dispatchEvent(new DragEvent('drop', { dataTransfer: data, bubbles: true, cancelable: true })); })()"
        )

    def mouse(self, kind, x, y):
        button = "none" if kind == "mouseMoved" else "left"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1)

    def place(self, list_, index):
        """Returns the position on the screen of an entry of the config's list `list_`."""
        return self.evaluate(
            "(() => { const v = page.state.views[0]; v.canvas.scrollIntoView({ block: 'center' });"
            " const { X, Y } = page.stage.place_on(v.canvas, v.crop), box = v.canvas.getBoundingClientRect();"
            f" const [x, y] = page.state.config.world.{list_}[{index}];"
            " return [box.left + X(x) + 1, box.top + Y(y) + 1]; })()"
        )

    def lose_gpu(self):
        """Crashes Chromium's GPU process. This call is not for the page, but for the browser."""
        session, self.session = self.session, None
        self.call("Browser.crashGpuProcess")
        self.session = session

    def tasks(self, call):
        """Calls a function. Returns the tasks of the page's main thread meanwhile.

        A task is a pair of milliseconds: elapsed time and processor time.
        """
        kept = len(self.events)
        self.call("Tracing.start", traceConfig={"includedCategories": ["toplevel"]}, transferMode="ReportEvents")
        call()
        self.call("Tracing.end")
        while not any(event["method"] == "Tracing.tracingComplete" for event in self.events[kept:]):
            self.events.append(self.message())
        chunks = [event["params"]["value"] for event in self.events if event["method"] == "Tracing.dataCollected"]
        self.events = [event for event in self.events if not event["method"].startswith("Tracing.")]
        events = list(itertools.chain(*chunks))
        names = [e for e in events if e["name"] == "thread_name"]
        mains = {(e["pid"], e["tid"]) for e in names if e["args"]["name"] == "CrRendererMain"}
        tasks = [e for e in events if e["name"].endswith("RunTask") and (e["pid"], e["tid"]) in mains and "tdur" in e]
        return [(e["dur"] / 1000, e["tdur"] / 1000) for e in tasks]

    def train(self, seconds=300):
        """Trains, and returns the digest of each arm by its label."""
        self.evaluate("window.before = page.state.training; 0")
        self.click("#train")
        self.wait(f"page.state.training !== before && {DONE}", seconds)
        return {
            arm["label"]: arm["digest"]
            for arm in self.evaluate("page.state.training.arms.map(({ label, digest }) => ({ label, digest }))")
        }


def downloaded(path, seconds=120):
    """Waits for a file that the page saves, and returns its content."""
    deadline = time.monotonic() + seconds
    while not (path.exists() and path.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.05)
    return path.read_bytes()


def base64(content):
    import base64

    return base64.b64encode(content).decode()


def check_slow_network(tab, page):
    """Tests that the opening moves and answers before the module has arrived, and that the page shifts little."""
    content, rest = page.read_bytes(), threading.Event()
    head, module = content[: content.index(b'id="wasm"') + 1000], content[content.index(b'id="wasm"') + 1000 :]

    class Slow(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(head)
            self.wfile.flush()
            rest.wait(60)
            self.wfile.write(module)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Slow)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    tab.call("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/")
    tab.wait("performance.getEntriesByName('motion').length", 20)
    assert not tab.evaluate("document.querySelector('#wasm')?.nextElementSibling"), "the module is there"
    # What needs no module works at once, and what needs it waits for it.
    tab.click("#guide-choices button")
    assert tab.evaluate("page.state.views[0].removed.group")
    tab.click("#replay")
    tab.set("#step", 9)
    assert tab.evaluate("page.state.views[0].place") == 9
    assert tab.evaluate("document.querySelector('#text').value") == tab.evaluate("page.state.text") != ""
    tab.click("[data-mode=drive]")
    assert tab.evaluate("document.querySelector('#again').disabled"), "a leader can be steered before it is there"
    tab.click("[data-mode=arrange]")
    assert tab.text("#views h2") == "Where everyone starts"
    assert tab.evaluate("page.state.views[0].data.episodes[0].headings.length") == 24
    assert tab.evaluate("page.state.views[0].data.episodes[0].coupling.join()") == "6,6,6,6"
    tab.set("#layout", "chaotic")
    rest.set()
    tab.wait(f"{READY} && document.querySelector('#layout').value === 'chaotic'")
    tab.wait("page.state.config.world.coupling === 5")
    server.shutdown()
    # The sum of layout shifts, while the page opens and while it trains.
    shift = "new PerformanceObserver(list => list.getEntries().forEach(({ value, hadRecentInput, sources }) => {"
    shift += " if (hadRecentInput) return;"
    shift += " shifts += value; moved.push(...sources.map(({ node }) => node?.id ?? node?.className));"
    shift += " })).observe({ type: 'layout-shift', buffered: true })"
    source = f"window.shifts = 0; window.moved = []; {shift}"
    script = tab.call("Page.addScriptToEvaluateOnNewDocument", source=source)["identifier"]
    for width, height in [(1280, 800), (1024, 768), (820, 1180), (390, 844)]:
        tab.window(width, height, dark=False)
        for settings in [{}, {"layout": "generally_forward", "on": "cpu", "pace": "full", **SMALL}]:
            tab.load(page, **settings)
            time.sleep(0.3)
            assert tab.evaluate("shifts") < 0.1, (width, settings, tab.evaluate("shifts"), tab.evaluate("moved"))
        tab.train()
        time.sleep(0.5)
        assert tab.evaluate("shifts") < 0.1, (width, "training", tab.evaluate("shifts"), tab.evaluate("moved"))
        # The guide has room for what it says after a training.
        tab.load(page)
        for selector in ["#guide-choices button", "#guide-next", "#guide-choices button"]:
            tab.click(selector)
        tab.wait("document.querySelector('#guide-says').textContent.includes('Training is finished.')")
        time.sleep(0.5)
        assert tab.evaluate("shifts") < 0.1, (width, "the guide", tab.evaluate("shifts"), tab.evaluate("moved"))
        # What the guide speaks of is in the window, the chart as well.
        chart = "document.querySelector('#curves').getBoundingClientRect().bottom - innerHeight"
        assert tab.evaluate(chart) <= 0, (width, tab.evaluate(chart))
        if width not in [1280, 390]:
            continue
        # Its fourth step trains whole populations before they are shown. The third is stopped, and says so.
        for selector in ["#guide-next", "#guide-choices button"]:
            tab.click(selector)
        tab.wait("page.state.training?.arms.length === 3 && page.state.training.reached >= 1")
        tab.click("#stop")
        tab.wait("document.querySelector('#guide-says').textContent.includes('It is: 500.')")
        time.sleep(1)
        reached = tab.evaluate("page.state.training.reached")
        assert f" Stopped after generation {reached}. " in tab.text("#guide-says"), (reached, tab.text("#guide-says"))
        tab.click("#guide-next")
        tab.evaluate("shifts = 0; moved = []; 0")
        tab.click("#guide-choices button")
        assert tab.text("#guide-says").endswith(" The populations are being trained…"), tab.text("#guide-says")
        tab.wait("page.state.exhibit?.name === 'evolution' && !page.state.exhibit.pending")
        time.sleep(0.5)
        assert tab.evaluate("shifts") < 0.1, (width, "populations", tab.evaluate("shifts"), tab.evaluate("moved"))
        tab.set("#pace", "full")
        for selector in ["#guide-next", "#guide-choices button"]:
            tab.click(selector)
        tab.wait("document.querySelector('#guide-says').textContent.includes('Training is finished.')", 60)
        assert tab.evaluate(chart) <= 0, (width, "the last step", tab.evaluate(chart))
    tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    tab.window(1280, 900, dark=False)
    print("the opening moves before the module has arrived, and the page shifts little")


# Controls that are alone on a line of several, and do not fill half of it.
LONE = """[...document.querySelectorAll('.row, #setup')].flatMap(row => {
  if (row.parentElement.closest('.row, #setup')) return [];
  const lines = [], controls = [...row.querySelectorAll('button, label, output:not(:empty)')];
  for (const control of controls.filter(e => e.checkVisibility())) {
    const { top, bottom } = control.getBoundingClientRect();
    const line = lines.find(line => top < line.bottom && bottom > line.top);
    if (line) line.controls.push(control); else lines.push({ top, bottom, controls: [control] });
  }
  const lone = ({ controls: [first, ...more] }) =>
    !more.length && first.tagName !== 'OUTPUT' && first.offsetWidth < row.clientWidth / 2;
  return lines.filter(line => lines.length > 1 && lone(line)).map(({ controls: [{ textContent }] }) => textContent);
})"""


def check_map_in_view(tab, page):
    """Tests that the maps are inside the window, without scrolling, after whatever changes what they show."""
    outside = (
        "page.state.views.map(view => view.canvas.getBoundingClientRect()).filter(({ top, bottom, left, right }) =>"
        " top < (document.querySelector('#bar')?.getBoundingClientRect().bottom ?? 0) - 1 || bottom > innerHeight"
        " || left < 0 || right > innerWidth).map(({ top, bottom, left, right }) => [top, bottom, left, right])"
    )
    press = "document.querySelector({!r}).click()".format

    def look(what, width):
        assert tab.evaluate(outside) == [], (what, width, tab.evaluate(outside))
        train = tab.evaluate("document.querySelector('#train').getBoundingClientRect().toJSON()")
        assert train["top"] >= 0 and train["right"] <= width, (what, width, train)

    def look_below(mode, width, height):
        """Tests that the controls below a map to arrange or to steer are in view, and that no control is alone."""
        if mode != "watch":
            boxes = f"[...document.querySelectorAll('#{mode} button')].map(e => e.getBoundingClientRect())"
            bottom = tab.evaluate(f"Math.max(...{boxes}.map(({{ bottom }}) => bottom))")
            assert bottom <= height, (mode, width, bottom)
        assert tab.evaluate(LONE) == [], (mode, width, tab.evaluate(LONE))

    for width, height in [(1280, 800), (1024, 768), (820, 1180), (390, 844)]:
        tab.window(width, height, dark=False)
        # Also if settings, or a note on a damaged link, are above the map, and if classes of agents have more controls.
        cases = [({"layout": "chaotic"}, ""), ({"learners": "lead", "compare": "x"}, ""), ({}, "rovers")]
        for settings, name in cases:
            tab.load(page, **settings)
            if name:
                tab.drop(f"{name}.toml", base64((CONFIGS / f"{name}.toml").read_bytes()))
                tab.wait("page.state.start.classes?.length === 2")
            tab.evaluate("document.querySelector('#more').open = true; 0")
            for mode in ["arrange", "drive"]:
                tab.evaluate(f"scrollTo(0, 0); {press(f'[data-mode={mode}]')}; 0")
                look(mode, width)
                look_below(mode, width, height)
                assert tab.text("#chosen") == "Nothing is chosen.", (width, tab.text("#chosen"))
            # Start neither moves nor gets wider when it is pressed. At some widths, a wider button would wrap.
            place = "(({ left, top, width }) => [left, top, width])"
            place += "(document.querySelector('#again').getBoundingClientRect())"
            before = tab.evaluate(place)
            tab.evaluate(f"{press('#again')}; 0")
            tab.wait("document.querySelector('#driven').textContent")
            assert tab.evaluate(place) == before, (width, settings, name)
        tab.load(page)
        look("the opening", width)
        assert tab.evaluate(LONE) == [], (width, tab.evaluate(LONE))
        # Settings are in one row.
        boxes = "[...document.querySelectorAll('#setup > :not([hidden])')].map(e => e.getBoundingClientRect())"
        row = tab.evaluate(f"Math.max(...{boxes}.map(b => b.top)) < Math.min(...{boxes}.map(b => b.bottom))")
        assert row or width < 640, (width, "settings")
        # An agent that strays widens the map a little.
        stray = "(() => { const { data } = page.state.views[0], [own] = data.episodes, positions = own.positions.slice();"
        stray += " positions.fill(50, -2 * own.agents); const crops = [data, { ...data, episodes: [{ ...own, positions }] }];"
        stray += " return crops.map(page.stage.busy).map(([left, below, right, above]) => [right - left, above - below]); })()"
        (wide, tall), (wider, taller) = tab.evaluate(stray)
        assert wide < wider < 1.25 * wide and tall < taller < 1.4 * tall, (wide, wider, tall, taller)
        # There is no empty chart before a training.
        empty = "['curves', 'legend', 'scrub'].filter(id => document.getElementById(id).checkVisibility())"
        assert tab.evaluate(empty) == [], (width, tab.evaluate(empty))
        # The POIs that are lost without a leader are in view, too, and so is who is missing.
        tab.evaluate("scrollTo(0, 100000); " + press('#credits button[data-credit="true 3"]'))
        look("without a leader", width)
        assert tab.text("#views p").endswith(", without leader 3 and its followers"), tab.text("#views p")
        for scroll in [0, 100000]:
            for mode in ["arrange", "drive", "watch"]:
                tab.evaluate(f"scrollTo(0, {scroll}); {press(f'[data-mode={mode}]')}; 0")
                look(mode, width)
                look_below(mode, width, height)
        # Answers in the guide, Next, and Train leave the maps in view. The guide's text is longest after a training.
        # A visitor can press only what is in view.
        tab.load(page)
        tab.set("#pace", "full")
        for place, selector in enumerate(["#guide-choices button", "#guide-next", "#guide-choices button", "#train"]):
            tab.evaluate("window.before = page.state.training; scrollTo(0, 100000)")
            tab.evaluate(f"document.querySelector({selector!r}).scrollIntoView({{ block: 'nearest' }}); 0")
            tab.evaluate(f"{press(selector)}; 0")
            if selector == "#train":
                tab.wait("page.state.training !== before && page.state.views.every(view => view.data)")
            elif place == 2:
                tab.wait("document.querySelector('#guide-says').textContent.includes('Training is finished.')")
            look(selector, width)
        for name, arms in [("two_groups", 2), ("population", 3)]:
            tab.evaluate(f"scrollTo(0, 100000); {press(f'[data-exhibit={name}]')}; 0")
            tab.wait(f"page.state.views.length === {arms} && page.state.views.every(view => view.data)")
            look(name, width)
            # Titles are whole. All maps are side by side, in almost the width of a phone, and the chart is below them.
            cut = "page.state.views.filter(({ title: { parentElement: e } }) => e.scrollWidth > e.clientWidth).length"
            assert tab.evaluate(cut) == 0, (width, name)
            shown = tab.evaluate("page.state.views.reduce((sum, { canvas }) => sum + canvas.clientWidth, 0)")
            assert width > 640 or shown > 0.87 * width, (width, name, shown)
            tops = tab.evaluate("page.state.views.map(view => Math.round(view.canvas.getBoundingClientRect().top))")
            assert len(set(tops)) == 1, (width, tops)
            chart = tab.evaluate("document.querySelector('#curves').getBoundingClientRect().top")
            assert tops[0] < chart < height, (width, tops, chart)
        assert tab.evaluate(LONE) == [], (width, tab.evaluate(LONE))
    tab.assert_no_errors()
    tab.window(1280, 900, dark=False)
    print("the maps stay in view")


def check_consistency(tab, page, downloads):
    """Tests that nothing on the page is about something else than what it shows."""
    # The guide speaks only of its own experiments, and leads back to them.
    tab.load(page)
    tab.set("#layout", "chaotic")
    tab.wait("document.querySelector('#layout').value === 'chaotic' && page.state.config.world.coupling !== 6")
    assert "four leaders" not in tab.text("#guide-says") and "not part of the guide" in tab.text("#guide-says")
    tab.click("#guide-next")
    tab.wait("page.state.views[0].title.textContent.startsWith('A trained team')")
    # The question comes before its answer.
    assert tab.evaluate("page.state.views[0].removed === null"), tab.text("#views p")
    assert "not part of the guide" not in tab.text("#guide-says"), tab.text("#guide-says")
    # The way back to the guide from a rearranged map does not train again.
    tab.load(page)
    tab.set("#pace", "full")
    for selector in ["#guide-choices button", "#guide-next", "#guide-choices button"]:
        tab.click(selector)
    tab.wait(DONE)
    tab.evaluate("window.before = page.state.training; 0")
    tab.click("[data-mode=arrange]")
    assert "not part of the guide" in tab.text("#guide-says"), tab.text("#guide-says")
    tab.click("#guide-next")
    time.sleep(0.5)
    assert tab.evaluate("page.state.training === before && page.state.mode === 'watch'")
    assert "almost never coincide" in tab.text("#guide-says"), tab.text("#guide-says")
    # A view that is no longer on show asks for no episode of the next training.
    tab.evaluate(
        "(() => { const { training, views: [view] } = page.state, { champion } = training; window.asking = [];"
        " training.champion = (...words) => new Promise(done => setTimeout(done, 800)).then(() => champion.apply(training, words));"
        " for (const at of [1, 2]) page.seek(at);"
        " Object.defineProperty(view, 'asking', { set(value) { asking.push(value); }, get: () => true }); })()"
    )
    tab.click("[data-exhibit=blind]")
    tab.wait("page.state.training?.arms.length === 3 && page.state.training.reached >= 0 && asking.length > 0")
    time.sleep(0.3)
    assert tab.evaluate("asking.join()") == "false", tab.evaluate("asking.join()")
    # After another run is opened, the result of a former training is gone.
    tab.load(page, layout="strictly_forward", on="cpu", pace="full", learners="leader-follower", **SMALL)
    tab.train()
    tab.evaluate("document.querySelector('.home').click()")
    run = downloaded(downloads / "strictly_forward-leader-follower.zip")
    (downloads / "strictly_forward-leader-follower.zip").unlink()
    tab.load(page, layout="generally_forward", on="cpu", pace="full", **SMALL)
    tab.train()
    assert "all-leaders" in tab.text("#announced"), tab.text("#announced")
    tab.drop("run.zip", base64(run))
    tab.wait("document.querySelector('#message').textContent.startsWith('run.zip: the run is complete')")
    assert "all-leaders" not in tab.text("#announced"), tab.text("#announced")
    assert re.search(r"of 2 POIs: [0-9.]+ \(leader-follower\)\.$", tab.text("#announced")), tab.text("#announced")
    # The experiment that was chosen last is trained, even if another one was being started.
    arms = "page.state.training.arms.map(({ label }) => label).join()"
    for first, milliseconds in [("population", 5), ("population", 20), ("population", 50), ("groups", 0)]:
        tab.load(page, on="cpu", pace="full")
        both = [f"document.querySelector('[data-exhibit={name}]').click()" for name in [first, "blind"]]
        tab.evaluate(f"{both[0]}; setTimeout(() => {both[1]}, {milliseconds}); 0")
        tab.wait("page.state.chosen?.name === 'blind' && page.state.training?.reached >= 0")
        assert tab.evaluate(arms).startswith("start jitter 0.0,"), (first, milliseconds, tab.evaluate(arms))
    # The guide does not return if it is left while it waits for the populations of its fourth step. After an error,
    # they are trained again.
    tab.load(page)
    tab.evaluate(
        "window.failed = false; const { postMessage } = Worker.prototype;"
        " Worker.prototype.postMessage = function (data, ...more) { if (failed || data.words?.ask !== 'play')"
        " return postMessage.call(this, data, ...more); failed = true; throw new Error('no memory'); }; 0"
    )
    tab.evaluate(
        "window.unpacked = 0; const { unpack } = page.stage;"
        " page.stage.unpack = data => { unpacked += 1; return unpack(data); };"
        " page.state.guide = { step: 3, said: null }; document.querySelector('#pace').value = 'full'; 0"
    )
    tab.evaluate("document.querySelector('#pace').dispatchEvent(new Event('change')); 0")
    tab.click("#guide-next")
    tab.wait("failed && page.state.training?.reached >= 0")
    tab.click("#stop")
    tab.evaluate("unpacked = 0; document.querySelector('#guide-choices button').click(); 0")
    assert tab.text("#guide-says").endswith(" The populations are being trained…"), tab.text("#guide-says")
    tab.click("#guide-end")
    tab.wait("unpacked >= 150")
    time.sleep(0.3)
    assert tab.evaluate("document.querySelector('#guide').hidden"), "the guide returns"
    # What was said about a file is gone with the next experiment.
    tab.drop("mine.toml", base64(STAGED.encode()))
    tab.wait("document.querySelector('#message').textContent.startsWith('mine.toml is the config')")
    tab.evaluate("document.querySelector('[data-exhibit=blind]').click()")
    assert tab.text("#message") == "", tab.text("#message")
    # Controls that would do nothing are disabled, or say why.
    tab.load(page, layout="chaotic")
    dead = "['replay', 'trial', 'pause', 'stop', 'scrub', 'step', 'undo']"
    dead += ".filter(id => !document.getElementById(id).disabled)"
    assert tab.evaluate(dead) == [], tab.evaluate(dead)
    tab.click("#gif")
    assert tab.text("#message").startswith("There is no film yet"), tab.text("#message")
    tab.click("[data-mode=arrange]")
    assert tab.evaluate("document.querySelector('#remove').disabled")
    tab.evaluate("page.state.views[0].canvas.focus()")
    tab.press("]", "BracketRight")
    assert not tab.evaluate("document.querySelector('#remove').disabled")
    # A leader that is removed is not drawn, even if it was the last one, so that the config has a problem.
    tab.load(page)
    tab.drop("one.toml", base64(b"[world]\nleaders = [[5, 5]]\npois = [[5, 12]]\ncoupling = 1\n"))
    tab.wait("page.state.config.world.leaders.length === 1")
    tab.click("[data-mode=arrange]")
    tab.evaluate("page.state.views[0].canvas.focus()")
    tab.press("]", "BracketRight")
    tab.press("Delete", "Delete")
    tab.wait("!page.state.valid")
    assert tab.evaluate("page.state.views[0].data.episodes[0].leaders") == 0
    # A note on a damaged link stays when settings change, and a training starts.
    tab.load(page, layout="chaotic", learners="lead", on="cpu", pace="full", **SMALL)
    assert "This link is damaged" in tab.text("#trouble")
    tab.set("#coupling", "1")
    tab.wait("page.state.config.world.coupling === 1")
    assert "This link is damaged" in tab.text("#trouble"), tab.text("#trouble")
    tab.train()
    assert "This link is damaged" in tab.text("#trouble"), tab.text("#trouble")
    tab.set("#layout", "strictly_forward")
    tab.wait("page.state.config.world.pois.length === 2")
    assert tab.evaluate("document.querySelector('#trouble').hidden")
    assert not list(tab.complaints())
    print("the page says nothing about something else than it shows")


def check_classes(tab, page, native, folder):
    """Tests configs in full: they train, and their classes, radii and values are drawn, rearranged and steered."""
    view, episode = "page.state.views[0]", "page.state.views[0].data.episodes[0]"
    choose = f"{view}.chosen = {{}}; dispatchEvent(new Event('resize')); 0".format
    texts = "element => [element.textContent.trim(), element.querySelector('polygon').outerHTML]"
    for name, classes, unit in [
        ("rovers", ["4 × rover", "2 × drone"], "share of the POIs' value"),
        ("herd", ["3 × dog", "6 × sheep"], "POIs"),
    ]:
        tab.load(page)
        config = CONFIGS / f"{name}.toml"
        tab.drop(config.name, base64(config.read_bytes()))
        tab.wait("page.state.valid && page.state.start.classes?.length === 2")
        # Settings that classes replace are hidden.
        shown = "['paradigm', 'coupling'].map(id => document.querySelector('#' + id).closest('label').hidden)"
        assert tab.evaluate(shown) == [True, True]
        # Each class has its own mark, and each POI its own radius.
        (first, mark), (second, other) = tab.evaluate(f"[...document.querySelectorAll('.marks span')].map({texts})")
        assert [first, second] == classes and mark != other, (first, mark, second, other)
        assert ", ".join(classes) in tab.text("#views p"), tab.text("#views p")
        for key, value in {"generations": 3, "trials": 2, "population": 12}.items():
            tab.set(f"#{key}", str(value))
            tab.wait(f"page.state.config.learning.{key} === {value}")
        tab.set("#pace", "full")
        flags = ("--generations", "3", "--trials", "2", "--population", "12")
        ((label, digest),) = tab.train().items()
        assert label == " and ".join(own.split()[-1] for own in classes), label
        assert digest == native(f"classes-{name}", config, *flags), name
        tab.wait(f"{view}.data && !{view}.playing")
        assert f"{unit[0].upper()}{unit[1:]} observed by the champion" in tab.text("#legend"), tab.text("#legend")
        tab.assert_no_errors()
        # The others do what they learned, whatever the arms are called.
        tab.click("[data-mode=drive]")
        tab.click("#again")
        tab.wait("document.querySelector('#driven').textContent.includes('what they learned (')")
        tab.assert_no_errors()
    # Radii in the start view are those of the config. The largest is not that of all.
    tab.load(page)
    tab.drop("rovers.toml", base64((CONFIGS / "rovers.toml").read_bytes()))
    tab.wait(f"page.state.start.classes?.length === 2 && {view}.data.pois.length === 8")
    assert tab.evaluate(f"{view}.data.radii") == [3, 3, 3, 4, 4, 3, 3, 5]
    # A drone moves freely, so that keys and pointer set its velocity. A rover has to turn first.
    tab.click("[data-mode=drive]")
    for leader, sideways in [(4, True), (0, False)]:
        tab.set("#leader", str(leader))
        assert tab.text(f"#leader option:nth-child({leader + 1})") == ("drone 4" if sideways else "rover 0")
        tab.click("#again")
        tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'ArrowRight' }})); 0")
        tab.wait(f"{view}.place >= 3")
        tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keyup', {{ key: 'ArrowRight' }})); 0")
        at = f"{episode}.positions.slice({{0}} * 12 + {2 * leader}, {{0}} * 12 + {2 * leader} + 2)"
        (x0, y0), (x1, y1) = (list(tab.evaluate(f"[...{at.format(step)}]")) for step in [0, 3])
        assert (x1 - x0 > 2 and abs(y1 - y0) < 1e-6) if sideways else y1 - y0 > 0.1, (leader, x0, y0, x1, y1)
    # The first press of a key already steers.
    tab.set("#leader", "4")
    tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'ArrowRight' }})); 0")
    tab.wait(f"{view}.place >= 3")
    tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keyup', {{ key: 'ArrowRight' }})); 0")
    tab.click("#again")
    tab.mouse("mouseMoved", *tab.place("pois", 6))
    tab.wait(f"{episode}.observed[6] !== null", 60)
    tab.assert_no_errors()
    # Classes are rearranged in their tables, and comments stay.
    tab.click("[data-mode=arrange]")
    comments = tab.evaluate("page.state.text").count("#")
    tab.evaluate(f"{view}.canvas.focus(); " + choose(["leaders", 5]))
    tab.press("ArrowRight", "ArrowRight")
    tab.wait("page.state.toml.includes('at = [[24.0, 25.0], [27.0, 25.0]]')")
    tab.click('[data-add="agents.1"]')
    tab.wait("page.state.start.classes[1].count === 3")
    tab.click('[data-add="pois.1"]')
    tab.wait("page.state.start.groups[1].count === 3 && page.state.start.radii.length === 9")
    tab.evaluate(choose(["pois", 0]))
    tab.click("#remove")
    tab.wait("page.state.start.groups[0].count === 2")
    assert tab.evaluate("page.state.valid && page.state.text").count("#") == comments
    tab.assert_no_errors()
    # A link has them.
    text = tab.evaluate("page.state.text")
    tab.wait("location.hash.includes('config=')")
    tab.open(tab.evaluate("location.href"))
    tab.wait(READY)
    assert tab.evaluate("page.state.text") == text
    tab.assert_no_errors()
    # A group's lists of a value per POI keep their lengths. So do those of the short form.
    tab.drop("herd.toml", base64((CONFIGS / "herd.toml").read_bytes()))
    tab.wait("page.state.start.groups && page.state.start.groups[0].name === 'gate'")
    tab.click("[data-mode=arrange]")
    tab.click('[data-add="pois.0"]')
    tab.wait("page.state.valid && page.state.start.coupling.join() === '2,4,6,6,2,4,6'")
    tab.evaluate("document.querySelector('[data-exhibit=relay]').click(); 0")
    tab.wait("page.state.training && page.state.training.reached >= 0")
    tab.click("[data-mode=arrange]")
    tab.evaluate(choose(["pois", 1]))
    tab.click("#remove")
    tab.wait("page.state.valid && page.state.config.world.windows.length === 2")
    tab.assert_no_errors()
    # Keys that refer to agents and POIs by their numbers still refer to the same ones.
    def remove(text, list_, until):
        """Opens NUMBERED with more text, removes the first entry of a list from the map, and waits."""
        tab.load(page)
        tab.drop("numbered.toml", base64((NUMBERED + text).encode()))
        tab.wait("page.state.valid && page.state.config.world.heading?.length === 4")
        tab.click("[data-mode=arrange]")
        tab.evaluate(choose([list_, 0]))
        tab.click("#remove")
        tab.wait(f"page.state.valid && {until}")

    remove("[credit]\nremoves = [[0, 2], [1, 3]]\n", "leaders", "page.state.config.world.heading.join() === '1,2,3'")
    assert tab.evaluate("JSON.stringify(page.state.config.credit.removes)") == "[[0,2]]"
    tab.click("[data-add=leaders]")
    tab.wait("page.state.valid && page.state.config.world.heading.join() === '1,1,2,3'")
    assert tab.evaluate("JSON.stringify(page.state.config.credit.removes)") == "[[0,3]]"
    remove("after = [[], [0], [1]]\n", "pois", "JSON.stringify(page.state.config.world.after) === '[[],[0]]'")
    tab.assert_no_errors()
    # Agents and POIs in regions are shown and counted, and only the others can be rearranged. It trains.
    tab.load(page)
    tab.drop("regions.toml", base64(REGIONS.encode()))
    tab.wait(f"page.state.start.classes?.length === 2 && {episode}.agents === 1252")
    assert tab.text("#views p").startswith("2 × dog, 2500 × sheep, 3 POIs"), tab.text("#views p")
    assert [own for own, _ in tab.evaluate(f"[...document.querySelectorAll('.marks span')].map({texts})")] == [
        "2 × dog", "2500 × sheep"
    ]
    tab.click("[data-mode=arrange]")
    adds = "[...document.querySelectorAll('#adds button')].map(button => button.textContent)"
    assert tab.evaluate(adds) == ["Add a dog", "Add a POI (gate)"], tab.evaluate(adds)
    tab.evaluate(f"{view}.canvas.focus()")
    chosen = []
    for _ in range(4):
        tab.press("]", "BracketRight")
        chosen.append(tab.evaluate(f"{view}.chosen"))
    assert chosen == [["leaders", 0], ["leaders", 1], ["pois", 0], ["leaders", 0]], chosen
    tab.click('[data-add="agents.0"]')
    tab.wait("page.state.start.classes[0].count === 3")
    tab.set("#pace", "full")
    (digest,) = tab.train().values()
    config = folder / "regions.toml"
    config.write_text(tab.evaluate("page.state.text"))
    assert digest == native("regions", config)
    tab.assert_no_errors()
    # So they are when a leader is steered.
    tab.click("[data-mode=drive]")
    tab.click("#again")
    tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'ArrowUp' }})); 0")
    tab.wait("document.querySelector('#driven').textContent.includes('Yours: D = ')")
    sizes = tab.evaluate(f"(({{ positions, shown, agents, near }}) => [positions.length, near.length, shown.length, agents])({episode})")
    assert sizes == [2 * 6 * 1253, 3 * 6, 6, 1253], sizes
    tab.assert_no_errors()
    # A leader that chooses an agent goes to the one nearest to the pointer, or in the direction of the arrow keys.
    tab.load(page)
    tab.drop("choosing.toml", base64(CHOOSING.encode()))
    tab.wait("page.state.start.classes?.[0].choose")
    tab.click("[data-mode=drive]")
    for key, direction in [("ArrowLeft", [-1, 0]), ("ArrowUp", [0, 1]), ("ArrowRight", [1, 0])]:
        tab.click("#again")
        tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }})); 0")
        tab.wait(f"{view}.place >= 2")
        tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keyup', {{ key: '{key}' }})); 0")
        (x, y), moves = tab.evaluate(f"[{episode}.positions.slice(0, 2), {episode}.positions.slice(8, 10)].map(at => [...at])")
        assert [moves[0] - x, moves[1] - y] == direction, (key, x, y, moves)
    tab.assert_no_errors()
    # The start and the last step count as in the config. A fitness that no class learns by is neither offered nor compared.
    tab.load(page)
    tab.drop("moments.toml", base64(MOMENTS.encode()))
    tab.wait("page.state.start.common_fitness === false")
    assert "learning.fitness" in tab.text("#notes") and "has no effect" in tab.text("#notes"), tab.text("#notes")
    hidden = "[document.querySelector('#fitness').closest('label'), document.querySelector('#compare option[value=fitness]')]"
    assert tab.evaluate(f"{hidden}.map(({{ hidden }}) => hidden)") == [True, True]
    tab.click("[data-mode=drive]")
    tab.click("#again")
    tab.wait(f"page.state.mode === 'drive' && {episode}.observed[0] === 0")
    tab.evaluate(f"{view}.canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'ArrowUp' }})); 0")
    tab.wait(f"{view}.place >= 2")
    if tab.evaluate(f"{view}.place") < 4:
        assert tab.evaluate(f"{episode}.observed") == [0, None]
    tab.wait("document.querySelector('#driven').textContent.includes('The team observed 2 of 2 POIs')")
    assert tab.evaluate(f"{episode}.observed") == [0, 4] and tab.evaluate(f"[...{episode}.near]") == [2, 2] * 5
    tab.assert_no_errors()
    # The value of the POIs that are lost is the credit.
    tab.evaluate("document.querySelector('#guide-end').click(); 0")
    tab.load(page, on="cpu", pace="full")
    tab.evaluate("document.querySelector('[data-exhibit=rovers]').click(); 0")
    tab.wait(DONE, 200)
    tab.wait(f"page.state.views.every(view => view.data && view.data.episodes[0].generation === 100)")
    credits = tab.evaluate(f"{episode}.d")
    for leader, d in enumerate(credits):
        tab.evaluate(f"document.querySelector('#credits [data-credit=\"false {leader}\"]').click(); 0")
        assert tab.text("#lost").endswith(f" {round(d, 3):g}."), (tab.text("#lost"), d)
    assert max(credits) > 0 and tab.text("#lost").startswith("Without drone 5"), tab.text("#lost")
    tab.assert_no_errors()
    print("configs in full train, and their classes are drawn, rearranged and steered")


def check_history(tab, page):
    """Tests that Back returns to results, that links open what is on show, and what Space does."""
    digests, arms = (f"page.state.training.arms.map(arm => arm.{key}).join()" for key in ["digest", "label"])
    tab.load(page, layout="generally_forward", on="cpu", pace="full", **SMALL)
    tab.train()
    tab.set("#scrub", 4)
    first, text = tab.evaluate(digests), tab.evaluate("page.state.text")
    tab.click("[data-exhibit=blind]")
    tab.wait("page.state.training && page.state.training.arms.length === 3 && page.state.training.reached >= 1")
    tab.evaluate("history.back(); 0")
    tab.wait("page.state.training && page.state.training.arms.length === 2")
    assert tab.evaluate(digests) == first and tab.evaluate("page.state.text") == text
    at_four = "view.data && view.data.episodes[0].generation === 4"
    tab.wait(f"page.state.views.length === 2 && page.state.views.every(view => {at_four})")
    assert tab.text(".sha") == first.split(",")[0]
    assert tab.evaluate("location.hash").startswith("#layout=generally_forward")
    assert tab.evaluate("document.querySelector('#stale').hidden")
    tab.evaluate("history.forward(); 0")
    tab.wait("page.state.training && page.state.training.arms.length === 3")
    assert tab.evaluate(arms).startswith("start jitter"), tab.evaluate(arms)
    tab.wait("page.state.views.every(view => view.data)")
    # The intervals and baselines of results that were left early are made after the return.
    tab.wait("page.state.training.state === 'stopped' && page.state.training.found")
    tab.wait("page.state.training.arms.every(({ constant }) => constant !== null)")
    tab.evaluate("history.back(); 0")
    tab.wait("page.state.training.state === 'done' && page.state.training.arms.every(({ random }) => random.length === 7)")
    tab.evaluate("history.forward(); 0")
    tab.wait("page.state.training.arms.length === 3")
    tab.assert_no_errors()
    # Two steps back at once lose no results, either.
    tab.click("[data-exhibit=relay]")
    tab.wait("page.state.training && page.state.training.arms[0].label === 'trained with D' && page.state.training.reached >= 0")
    slow = "(...words) => new Promise(done => setTimeout(done, 300)).then(() => ask.apply(player, words))"
    tab.evaluate(
        "window.player = page.state.players[0]; window.ask = player.ask;"
        f" player.ask = {slow}; addEventListener('popstate', () => history.back(), {{ once: true }}); history.back(); 0"
    )
    tab.wait("page.state.training && page.state.training.arms.length === 2")
    time.sleep(0.5)
    tab.evaluate("delete player.ask; history.forward(); 0")
    tab.wait("page.state.training && page.state.training.arms.length === 3")
    assert tab.evaluate(arms).startswith("start jitter"), tab.evaluate(arms)
    tab.assert_no_errors()
    # Back within the guide returns to what the guide said.
    tab.load(page)
    tab.set("#pace", "full")
    tab.click("#guide-choices button")
    tab.click("#guide-next")
    question = tab.text("#guide-says")
    tab.click("#guide-choices button")
    tab.wait("page.state.training && page.state.training.reached >= 0")
    tab.evaluate("history.back(); 0")
    tab.wait("page.state.exhibit && page.state.exhibit.name === 'opening'")
    assert tab.text("#guide-says") == question, tab.text("#guide-says")
    # Back from the first experiment of the gallery returns to the opening.
    tab.load(page)
    tab.click("[data-exhibit=relay]")
    tab.wait("page.state.training && page.state.training.reached >= 0")
    tab.evaluate("history.back(); 0")
    tab.wait("!page.state.training && page.state.exhibit && page.state.exhibit.name === 'opening'")
    assert tab.text("#views h2").startswith("A trained team") and tab.evaluate("location.hash") == ""
    # A link to the opening opens the opening. A link to results opens these, even if the settings have changed since.
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("#share")
    tab.wait("window.copied")
    assert tab.evaluate("copied") == page.as_uri(), tab.evaluate("copied")
    tab.load(page, layout="strictly_forward", on="cpu", pace="full", **SMALL)
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.train()
    first = tab.evaluate(digests)
    tab.set("#seed", "99")
    tab.wait("!document.querySelector('#stale').hidden")
    tab.click("#share")
    tab.wait("window.copied")
    tab.open(tab.evaluate("copied"))
    tab.wait(f"{READY} && {DONE}")
    assert tab.evaluate(digests) == first
    # While a map is rearranged, a link opens this map, and not the training.
    tab.click("[data-mode=arrange]")
    tab.click("[data-add=pois]")
    tab.wait("document.querySelector('#layout').value === 'own'")
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("#share")
    tab.wait("window.copied")
    assert "play=" not in tab.evaluate("copied") and "config=" in tab.evaluate("copied"), tab.evaluate("copied")
    assert tab.text("#message") == "The link is copied: whoever opens it trains the same.", tab.text("#message")
    # Space pauses and resumes what plays. Otherwise it scrolls.
    space = "(() => { const key = new KeyboardEvent('keydown', { key: ' ', bubbles: true, cancelable: true });"
    space += " document.body.dispatchEvent(key); return key.defaultPrevented; })()"
    tab.load(page, layout="chaotic")
    assert not tab.evaluate(space)
    tab.load(page)
    tab.wait("page.state.views[0].playing")
    assert tab.evaluate(space) and not tab.evaluate("page.state.views[0].playing")
    assert tab.evaluate(space) and tab.evaluate("page.state.views[0].playing")
    # With reduced motion, the guide starts no motion.
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    tab.load(page)
    tab.click("#guide-choices button")
    assert tab.evaluate("page.state.views[0].removed.group && !page.state.views[0].playing")
    tab.window(1280, 900, dark=False)
    tab.assert_no_errors()
    print("Back returns to results, links open what is on show, and Space pauses and resumes only what plays")


def check_links_and_devices(tab, page):
    """Tests links, small windows, focus, live announcements, reduced motion, and touch."""
    trouble = "document.querySelector('#trouble').textContent"
    # A damaged link gives an error, and the address does not change.
    tab.load(page, layout="chaotic", seed=3)
    tab.evaluate("page.state.text += '\\n# mine\\n'; 0")
    tab.evaluate("page.configs.pack(page.state.text).then(word => { window.word = word; }); 0")
    tab.wait("window.word")
    word = tab.evaluate("window.word")
    truncated, mistyped = {"config": word[: len(word) // 2]}, {"layout": "generally_f"}
    for settings in [truncated, mistyped, {"layout": "chaotic", "learners": "lead"}, {"seeds": "3"}]:
        tab.load(page, **settings)
        key, value = list(settings.items())[-1]
        message = tab.evaluate(trouble)
        assert "This link is damaged" in message and key in message, message
        assert tab.evaluate("location.hash").endswith(value), tab.evaluate("location.hash")
    # The note about a damaged link returns with its experiment.
    tab.load(page, layout="generally_f", on="cpu", pace="full", **SMALL)
    tab.train()
    tab.click("[data-exhibit=blind]")
    tab.wait("page.state.training?.arms.length === 3 && page.state.training.reached >= 0")
    assert not tab.evaluate(trouble), tab.evaluate(trouble)
    tab.evaluate("history.back(); 0")
    tab.wait("page.state.training?.arms.length === 2")
    assert "This link is damaged" in tab.evaluate(trouble), tab.evaluate(trouble)
    # A link to a generation that is opened in the same tab trains, too.
    words = "&".join(f"{key}={value}" for key, value in SMALL.items())
    tab.evaluate(f"location.hash = '#layout=chaotic&on=cpu&learners=leader-follower&{words}&generation=2&trial=1&play=1'; 0")
    tab.wait(f"{DONE} && page.state.training.arms.length === 1 && page.state.generation === 2 && page.state.trial === 1")
    # An error about a file ends when another link is opened.
    tab.drop("curves.png", base64(b"\x89PNG"))
    tab.wait(f"{trouble}.includes('curves.png')")
    tab.evaluate("location.hash = '#layout=chaotic&seed=5'; 0")
    tab.wait("page.state.config.learning.seed === '5' && document.querySelector('#trouble').hidden")
    # No link is copied while the config has errors.
    tab.load(page, layout="chaotic")
    address = tab.evaluate("location.href")
    tab.set("#text", "[world]\nsteps = 0\n")
    tab.wait("!page.state.valid")
    tab.click("#share")
    tab.wait("document.querySelector('#message').textContent.startsWith('No link was copied')")
    assert tab.evaluate("location.href") == address
    # A problem of a setting is shown beside it, even if the setting is folded away, and ends with it.
    tab.load(page, layout="chaotic")
    tab.set("#population", "1")
    tab.wait("!page.state.valid")
    beside = "document.querySelector('#population').closest('label').querySelector('.wrong')"
    assert tab.evaluate(f"{beside}.checkVisibility()")
    assert "allowed" in tab.evaluate(f"{beside}.textContent"), tab.evaluate(f"{beside}.textContent")
    assert not tab.evaluate("document.querySelector('#config').open"), "the editor opens for a problem of a setting"
    tab.set("#population", "10")
    tab.wait(f"page.state.valid && !{beside}")
    tab.assert_no_errors()
    # An empty field is reset to the value in use.
    tab.load(page, layout="chaotic", seed=12)
    tab.set("#seed", "")
    assert tab.evaluate("document.querySelector('#seed').value") == "12"
    # Undo restores an edited map after another layout was chosen.
    tab.click("[data-mode=arrange]")
    tab.click("[data-add=pois]")
    tab.wait("document.querySelector('#layout').value === 'own'")
    text = tab.evaluate("page.state.text")
    tab.set("#layout", "strictly_forward")
    tab.wait(
        "document.querySelector('#layout').value === 'strictly_forward' && page.state.config.world.leaders.length === 2"
    )
    tab.click("#undo")
    tab.wait("document.querySelector('#layout').value === 'own'")
    assert tab.evaluate("page.state.text") == text
    tab.assert_no_errors()
    # It takes back what was typed before what was chosen earlier.
    tab.load(page)
    tab.set("#layout", "chaotic")
    tab.wait("document.querySelector('#layout').value === 'chaotic' && page.state.config.world.coupling === 5")
    text = tab.evaluate("page.state.text")
    tab.set("#text", f"{text}# typed\n")
    tab.wait("page.state.text.endsWith('# typed\\n')")
    tab.click("#undo")
    tab.wait(f"page.state.text === {json.dumps(text)}")
    # After a removal, the keys still reach the map.
    tab.click("[data-mode=arrange]")
    tab.evaluate("page.state.views[0].canvas.focus()")
    tab.press("]", "BracketRight")
    tab.evaluate("document.querySelector('#remove').focus(); document.querySelector('#remove').click()")
    assert tab.evaluate("document.activeElement === page.state.views[0].canvas"), "the focus is lost"
    # A setting that is hidden does not block Train, whatever its value.
    tab.window(390, 844, dark=False)
    tab.load(page, on="cpu", pace="full", **SMALL)
    tab.evaluate("document.querySelector('#more').open = false; document.querySelector('#coupling').max = 1; 0")
    tab.train()
    tab.assert_no_errors()
    # In a small window, the whole map is visible.
    tab.window(1280, 800, dark=False)
    tab.load(page, layout="generally_forward")
    tab.click("[data-mode=arrange]")
    tab.wait("page.state.views[0].data")
    box = "page.state.views[0].canvas.getBoundingClientRect()"
    top, bottom = tab.evaluate(f"[{box}.top, {box}.bottom]")
    assert top >= 0 and bottom <= 800, (top, bottom)
    # After a change of settings, the page says that its results are from the old ones.
    tab.load(page, on="cpu", pace="full", **SMALL)
    tab.evaluate("document.querySelector('#train').focus(); document.querySelector('#setup').requestSubmit(); 0")
    tab.wait(DONE)
    assert tab.evaluate("document.activeElement.id") == "train", "the focus is lost"
    assert tab.text("#announced").startswith("Training is finished."), tab.text("#announced")
    assert tab.evaluate("document.querySelector('#stale').hidden")
    # The page is also shown again while the new config is being read, as it is when an episode ends then.
    tab.evaluate("setInterval(() => document.querySelector('#curves').dispatchEvent(new Event('pointerleave')), 0); 0")
    tab.set("#fitness", "D")
    tab.wait("!document.querySelector('#stale').hidden")
    assert "fitness Df, seed 7" in tab.text("#stale"), tab.text("#stale")
    tab.set("#fitness", "Df")
    tab.wait("document.querySelector('#stale').hidden")
    tab.set("#coupling", "5")
    tab.wait("!document.querySelector('#stale').hidden")
    assert "with another config or comparison" in tab.text("#stale"), tab.text("#stale")
    tab.click("#undo")
    tab.wait("document.querySelector('#stale').hidden")
    # During training, other trials and generations can be shown, and configs are checked. Training can be stopped.
    tab.load(page, layout="generally_forward", on="cpu", pace="full", population=4096, generations=100000)
    tab.evaluate(
        "window.said = []; const region = document.querySelector('#announced');"
        " new MutationObserver(() => said.push(1)).observe(region, { childList: true }); 0"
    )
    tab.click("#train")
    tab.wait("page.state.training && page.state.training.reached >= 2")
    tab.set("#trial", "1")
    assert tab.evaluate("page.state.follow")
    tab.set("#scrub", 0)
    assert not tab.evaluate("page.state.follow")
    tab.click("#following")
    assert tab.evaluate("page.state.follow")
    tab.set("#text", "[world]\nsteps = 0\n")
    tab.wait("!page.state.valid", 20)
    tab.click("#stop")
    tab.wait("page.state.training.state === 'stopped' && document.querySelector('#stop').disabled")
    assert tab.text("#announced").startswith("Stopped after generation"), tab.text("#announced")
    assert tab.evaluate("said.length") <= 3, "the live region changes too often"
    # With reduced motion, replays start only on request, and the slider of steps works.
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    tab.load(page, on="cpu", pace="full", **SMALL)
    tab.train()
    tab.wait("page.state.views.every(view => view.data && view.data.episodes[0].generation === 6 && !view.playing)")
    tab.click("#replay")
    assert tab.evaluate("page.state.views[0].playing")
    tab.set("#step", 7)
    assert tab.evaluate("page.state.views.map(view => [view.place, view.playing])") == [[7, False]] * 2
    # A tap sets the leader's target, and the leader continues after the finger is lifted.
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True)
    tab.window(390, 844, dark=False)
    tab.load(page, layout="generally_forward")
    tab.click("[data-mode=drive]")
    tab.wait("page.state.views[0].data")
    x, y = tab.place("pois", 0)
    tab.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
    tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    tab.wait("page.state.views[0].place >= 5", 30)
    # Phones zoom into fields with a font smaller than 16 pixels.
    small = tab.evaluate(
        "[...document.querySelectorAll('input[type=number], select, textarea')]"
        ".filter(e => e.checkVisibility() && parseFloat(getComputedStyle(e).fontSize) < 16).map(e => e.id)"
    )
    assert not small, small
    tab.call("Emulation.setTouchEmulationEnabled", enabled=False)
    tab.window(1280, 900, dark=False)
    print("links, small windows, focus, reduced motion and touch work")


def check_several_runs(tab, page, flotilla, folder):
    """Tests that runs opened together become arms of one chart."""
    folder.mkdir(exist_ok=True)

    def run(name, layout, *flags):
        command = [flotilla, "train", CONFIGS / f"{layout}.toml", "--seed", "7", "--population", "20", *flags]
        subprocess.run([*map(str, command), "--out", str(folder / name), "--quiet", "--backend", "cpu"], check=True)
        return pack(f"{name}.zip", files_of(name))

    def files_of(name):
        return [f"{name}/{file}" for file in ["config.toml", "metrics.csv", "policies.safetensors", "run.json"]]

    def pack(archive, paths):
        """Packs files of runs, and returns the archive in base64."""
        with zipfile.ZipFile(folder / archive, "w") as to:
            for path in paths:
                to.write(folder / path, path)
        return base64((folder / archive).read_bytes())

    def cells(selector):
        rows = "tr => [...tr.cells].map(cell => cell.textContent)"
        return tab.evaluate(f"[...document.querySelectorAll('{selector} tr')].map({rows})")

    def open_and_compare(names):
        """Opens runs, and compares the page's tables with those of the program."""
        tab.drop_all({f"{name}.zip": files[name] for name in names})
        tab.wait(f"document.querySelector('#message').textContent.startsWith('{len(names)} runs are compared')")
        digests = [json.loads((folder / name / "run.json").read_text())["digest"] for name in names]
        assert tab.evaluate("[...document.querySelectorAll('.sha')].map(code => code.textContent)") == digests
        command = [flotilla, "compare", *(folder / name for name in names)]
        output = subprocess.run([*map(str, command)], check=True, capture_output=True, text=True).stdout
        tables, rows = [[]], [line.strip("|").split("|") for line in output.splitlines() if line.startswith("|")]
        for row in ([cell.strip() for cell in row] for row in rows):
            if row[0] == "measure":
                tables.append([])
            if row[0].strip("-"):
                tables[-1].append(row)
        assert cells("#means") == tables[0] and cells("#pairs") == tables[1], (output, cells("#means"), cells("#pairs"))

    files = {
        "of-g": run("of-g", "strictly_forward", "--fitness", "G", "--generations", "6", "--trials", "3"),
        "of-df": run("of-df", "strictly_forward", "--fitness", "Df", "--generations", "6", "--trials", "3"),
        "longer": run("longer", "generally_forward", "--generations", "9", "--trials", "2"),
    }
    tab.load(page)
    assert not tab.evaluate("document.querySelector('#guide').hidden")
    open_and_compare(["of-g", "of-df"])
    assert tab.evaluate("document.querySelector('#guide').hidden"), "the guide describes another team"
    # Colours belong to arms, whatever the order of files.
    tones = "Object.fromEntries(page.state.training.arms.map(({ label, style }) => [label, style]))"
    first = tab.evaluate(tones)
    open_and_compare(["of-df", "of-g"])
    assert tab.evaluate(tones) == first == {"fitness G": 0, "fitness Df": 2}, (first, tab.evaluate(tones))
    open_and_compare(["of-g", "of-df"])
    # A link contains only settings, and the page says that it does not contain the runs.
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("#share")
    tab.wait("window.copied && document.querySelector('#message').textContent.includes('not the runs')")
    assert "play=" not in tab.evaluate("window.copied") and "fitness=G" in tab.evaluate("window.copied")
    assert tab.evaluate("page.state.training.arms.map(arm => arm.label)") == ["fitness G", "fitness Df"]
    assert "95 % interval" in tab.text("#legend") and "of 2" in tab.text("#legend"), tab.text("#legend")
    # The chart shows the intervals as bands: without them, its pixels differ.
    drawn = "(() => { dispatchEvent(new Event('resize')); return document.querySelector('#curves').toDataURL(); })()"
    banded = tab.evaluate(drawn)
    assert tab.evaluate("page.state.training.found.curves.some(curve => curve.band)")
    tab.evaluate("window.bands = page.state.training.found.curves.map(curve => curve.band); 0")
    tab.evaluate("page.state.training.found.curves.forEach(curve => { curve.band = null; }); 0")
    assert tab.evaluate(drawn) != banded, "no band is drawn"
    tab.evaluate("page.state.training.found.curves.forEach((curve, run) => { curve.band = bands[run]; }); 0")
    assert tab.evaluate(drawn) == banded
    tab.wait("page.state.views.length === 2")
    tab.wait("page.state.views.every(view => view.data && view.data.episodes[0].generation === 6)")
    tab.assert_no_errors()
    # With runs of different lengths, the shorter ones show their last generation. Only trials that all runs have can be
    # selected.
    open_and_compare(["of-g", "of-df", "longer"])
    generations = "page.state.views.map(view => view.data && view.data.episodes[0].generation).join()"
    tab.wait(f"{generations} === '6,6,9'")
    tab.set("#scrub", 8)
    tab.wait(f"{generations} === '6,6,8'")
    assert tab.evaluate("document.querySelector('#trial').length") == 2
    assert "Share of POIs" in tab.text("#legend"), tab.text("#legend")
    tab.assert_no_errors()
    # Files that cannot be opened together give an error, and change nothing.
    broken = base64(b"PK\x03\x04" + bytes(40))
    both = pack("both.zip", [*files_of("of-g"), *files_of("of-df")])
    for group, message in [
        ({"of-g.zip": files["of-g"], "mine.toml": base64(b"")}, "mine.toml: not a run"),
        ({"of-g.zip": files["of-g"], "broken.zip": broken}, "broken.zip: not an archive of a run"),
        ({"both.zip": both}, "both.zip: it has 2 runs"),
        ({f"{index}.zip": files["of-g"] for index in range(7)}, "open 6 runs at most"),
    ]:
        tab.drop_all(group)
        tab.wait(f"document.querySelector('#trouble').textContent.includes({json.dumps(message)})")
        tab.evaluate("document.querySelector('#trouble').textContent = ''")
        assert tab.evaluate("page.state.training.arms.length") == 3
    # All files of a run are read from one folder, even if a file of another run comes first.
    tab.drop("stray.zip", pack("stray.zip", ["of-df/metrics.csv", *files_of("of-g")]))
    tab.wait("document.querySelector('#message').textContent.startsWith('stray.zip: the run is complete')")
    assert tab.text(".sha") == json.loads((folder / "of-g" / "run.json").read_text())["digest"]
    assert not list(tab.complaints())
    print("several runs are arms of one chart, with the intervals and tests of the program")


# Elements whose content is wider than their box, and therefore cut off.
CUT = """[...document.querySelectorAll('main *')].filter(e => e.checkVisibility() &&
  e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).overflowX !== 'visible')
  .map(e => e.id || e.className || e.tagName)"""
# Many leaders at a POI, close to other POIs.
CROWDED = """
[world]
leaders = [
  [20, 20], [20.3, 20], [20.6, 20], [20, 20.3], [20.3, 20.3], [20.6, 20.3], [20, 20.6], [20.3, 20.6], [20.6, 20.6],
  [21, 21],
]
pois = [[20, 20.5], [24, 21], [20, 25], [21, 25.4]]
coupling = 3
"""
# Records the labels that the view drew last: text and box.
KEEP_LABELS = """(() => {
  const { fillText, clearRect } = CanvasRenderingContext2D.prototype;
  window.labels = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y, ...rest) {
    if (this.canvas.closest('#views')) {
      const half = this.measureText(text).width / 2;
      labels.push([text, x - half, y - 9, x + half, y]);
    }
    fillText.call(this, text, x, y, ...rest);
  };
  CanvasRenderingContext2D.prototype.clearRect = function (...area) {
    if (this.canvas.closest('#views')) labels.length = 0;
    clearRect.call(this, ...area);
  };
})()"""
# Counts how often the map and the chart are drawn.
COUNT_DRAWN = """(() => {
  const { clearRect } = CanvasRenderingContext2D.prototype;
  window.drawn = { map: 0, chart: 0 };
  CanvasRenderingContext2D.prototype.clearRect = function (...area) {
    drawn[this.canvas.id === "curves" ? "chart" : "map"] += 1;
    clearRect.call(this, ...area);
  };
})()"""
# Pairs of labels that overlap.
OVERPRINTED = """labels.flatMap((a, index) => labels.slice(0, index)
  .filter(b => a[1] < b[3] && b[1] < a[3] && a[2] < b[4] && b[2] < a[4]).map(b => [a[0], b[0]]))"""


def check_former_defects(tab, page, call, downloads, folder):
    """Tests that former defects do not return."""
    # Labels do not overlap, neither in motion nor if leaders are close together.
    tab.load(page)
    tab.evaluate(KEEP_LABELS)
    steps = int(tab.evaluate("document.querySelector('#step').max"))
    drawn = 0
    for step in range(steps + 1):
        tab.set("#step", step)
        overlaps = tab.evaluate(OVERPRINTED)
        assert overlaps == [], (step, overlaps)
        drawn += tab.evaluate("labels.length")
    assert drawn > 5 * steps, "hardly any labels are drawn"
    tab.evaluate("labels.length = 0")
    tab.drop("crowded.toml", base64(CROWDED.encode()))
    tab.wait("page.state.config.world.leaders.length === 10 && labels.length > 0")
    tab.evaluate("dispatchEvent(new Event('resize')); 0")
    assert tab.evaluate("labels.length") > 0 and tab.evaluate(OVERPRINTED) == []
    tab.assert_no_errors()
    # The map shows the generation of the slider when training pauses, resumes or stops, and when the slider is moved.
    tab.load(page, layout="generally_forward", on="cpu")
    same = (
        "page.state.views.every(view => view.data"
        " && view.data.episodes[0].generation === Number(document.querySelector('#scrub').value))"
    )
    tab.click("#train")
    tab.wait("page.state.training && page.state.training.reached >= 8")
    tab.click("#pause")
    tab.wait(same, 20)
    assert tab.evaluate("Number(document.querySelector('#scrub').value)") >= 8
    tab.click("[data-mode=arrange]")
    tab.click("[data-mode=watch]")
    tab.wait(same, 20)
    tab.set("#scrub", 3)
    tab.wait(same, 20)
    tab.click("[data-mode=arrange]")
    tab.click("[data-mode=watch]")
    tab.wait(same, 20)
    assert tab.evaluate("Number(document.querySelector('#scrub').value)") == 3
    tab.click("#pause")
    tab.wait("page.state.training.reached >= 20")
    tab.click("#stop")
    tab.wait("page.state.training.state === 'stopped'")
    tab.wait(same, 20)
    assert tab.evaluate("Number(document.querySelector('#scrub').value)") >= 20
    tab.assert_no_errors()
    # After another link is pasted, the page says that its results are from other settings.
    assert tab.evaluate("document.querySelector('#stale').hidden")
    tab.evaluate("location.hash = '#layout=chaotic&seed=5'; 0")
    tab.wait("page.state.config.learning.seed === '5' && !document.querySelector('#stale').hidden")
    # On a phone, the table of credit is not cut off, even with the largest number of columns.
    tab.window(390, 844, dark=False)
    tab.load(page, layout="generally_forward", on="cpu", pace="full", fitness="Dt", **SMALL)
    tab.train()
    tab.set("#scrub", 6)
    tab.wait("page.state.views.every(view => view.data && view.data.episodes[0].generation === 6)")
    tab.click('#credits button[data-credit="true 1"]')
    columns = tab.evaluate("[...document.querySelectorAll('#credits thead th')].map(cell => cell.textContent)")
    assert columns == ["Leader", "D", "Df", "D++", "Dt (fitness)", "Remove it", "Remove it and its followers"], columns
    assert not tab.evaluate(CUT), tab.evaluate(CUT)
    tab.window(1280, 900, dark=False)
    # In a wide window, the table has its other layout.
    tab.wait("document.querySelectorAll('#credits thead th').length === 5", 20)
    # For a slow generation, the page shows how long it has been playing.
    large = {"population": 60000, "learners": "all-leaders"}
    tab.load(page, layout="generally_forward", on="cpu", trials=1, generations=3, **large)
    tab.click("#train")
    tab.wait("/ s so far$/.test(document.querySelector('#generation').textContent)", 60)
    # The limit of memory applies to all arms together.
    tab.load(page, layout="generally_forward", on="cpu", population=20000, compare="learning.fitness:G,D,Df,D%2B%2B,Dt")
    tab.click("#train")
    tab.wait("document.querySelector('#trouble').textContent.startsWith('This takes ')")
    gibibytes = float(tab.text("#trouble").split()[2])
    assert 3 < gibibytes < 15, gibibytes
    assert not tab.evaluate("Boolean(page.state.training)")
    # A large config has a link.
    tab.load(page, layout="chaotic")
    text = (CONFIGS / "chaotic.toml").read_text().replace("steps = 50", "steps = 51")
    tab.drop("large.toml", base64(f"# {base64(os.urandom(200_000))}\n{text}".encode()))
    tab.wait("page.state.file === 'large' && page.state.valid && location.hash.length > 200000")
    tab.assert_no_errors()
    # Without CompressionStream, an edited map has no link, and no wrong link is copied. Links to layouts still work.
    script = tab.call("Page.addScriptToEvaluateOnNewDocument", source="delete window.CompressionStream")["identifier"]
    tab.load(page, layout="chaotic", seed=9)
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("[data-mode=arrange]")
    tab.click("[data-add=pois]")
    tab.wait("document.querySelector('#layout').value === 'own'")
    tab.click("#share")
    tab.wait("document.querySelector('#message').textContent.startsWith('No link was copied: this browser')")
    assert not tab.evaluate("Boolean(window.copied)")
    assert "chaotic" not in tab.evaluate("location.hash"), "the address names another experiment"
    tab.set("#layout", "strictly_forward")
    tab.wait("location.hash.includes('strictly_forward')")
    tab.click("#share")
    tab.wait("window.copied && window.copied.includes('strictly_forward')")
    tab.assert_no_errors()
    tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    # If the worker fails while the page opens, the page says so.
    source = "const { postMessage } = Worker.prototype; Worker.prototype.postMessage = function (data, ...more) {"
    source += " if (data.words?.ask === 'about') throw new Error('no memory'); postMessage.call(this, data, ...more); };"
    script = tab.call("Page.addScriptToEvaluateOnNewDocument", source=source)["identifier"]
    tab.open(f"{page.as_uri()}#layout=chaotic")
    tab.wait("document.body.dataset.shown !== undefined")
    assert "cannot run flotilla: no memory" in tab.text("#trouble"), tab.text("#trouble")
    assert not list(tab.complaints())
    tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    # A picture has its lines below each other on every screen. A film during a training shows one generation.
    tab.call("Emulation.setDeviceMetricsOverride", width=1280, height=900, deviceScaleFactor=2, mobile=False)
    tab.load(page, layout="generally_forward", on="cpu", population=20)
    tab.set("#text", tab.evaluate("page.state.text").replace("steps = 25", "steps = 6"))
    tab.wait("page.state.config.world.steps === 6")
    tab.evaluate(
        "window.lines = []; const { fillText } = CanvasRenderingContext2D.prototype;"
        " CanvasRenderingContext2D.prototype.fillText = function (text, x, y, ...rest) {"
        " if (!this.canvas.isConnected) lines.push([text, y, parseFloat(this.font.match(/[0-9.]+px/)[0])]);"
        " fillText.call(this, text, x, y, ...rest); }; 0"
    )
    tab.click("#train")
    tab.wait("page.state.training && page.state.training.reached >= 2 && page.state.views.every(view => view.data)")
    tab.click("#png")
    (_, title, _), (_, status, size) = tab.evaluate("lines.slice(0, 2)")
    assert status - title > size > 15, (title, status, size)
    tab.evaluate("lines.length = 0; 0")
    tab.click("#webm")
    tab.wait("page.state.message.endsWith('.webm is saved.')")
    filmed = "[...new Set(lines.flatMap(([text]) => text.match(/^generation [0-9]+/) ?? []))]"
    assert len(tab.evaluate(filmed)) == 1, tab.evaluate(filmed)
    assert tab.evaluate("page.state.training.reached") > 10
    tab.wait("page.state.views.every(view => view.data.episodes[0].generation > 10)")
    tab.click("#stop")
    tab.assert_no_errors()
    # A film ends when other maps are on show.
    tab.click("#webm")
    tab.click("[data-mode=arrange]")
    ended = "The film could not be made: other maps are on show"
    tab.wait(f"document.querySelector('#trouble').textContent.includes('{ended}')")
    tab.window(1280, 900, dark=False)
    # The saved config is that of the training, without later changes. The command names the saved file.
    text = (
        "[world]\nleaders = [[5, 5]]\nfollowers = [[4, 4], [6, 4]]\npois = [[5, 12]]\n"
        "[learning]\npopulation = 10\ngenerations = 3\ntrials = 2\n"
    )
    tab.load(page)
    tab.drop("my first map.toml", base64(text.encode()))
    tab.wait(f"page.state.text === {json.dumps(text)} && page.state.valid")
    tab.train()
    command, digest = tab.evaluate("(({ command, digest }) => [command, digest])(page.state.training.arms[0])")
    tab.set("#seed", "99")
    tab.wait("page.state.config.learning.seed === '99'")
    name = command.split()[2]
    buttons = "[...document.querySelectorAll('.digest button')]"
    tab.evaluate(f"{buttons}.find(button => button.textContent === 'Save {name}').click()")
    saved = downloads / name
    assert downloaded(saved).decode() == text
    call("train", saved, *command.split()[3:], "--out", folder / "first", "--quiet", "--backend", "cpu")
    assert json.loads((folder / "first" / "run.json").read_text())["digest"] == digest
    tab.assert_no_errors()
    # Without a compiler for WebAssembly, web/build says what to install.
    bare = folder / "bare"
    bare.mkdir()
    (bare / "rustc").write_text(f"#!/bin/sh\necho {bare}\n")
    (bare / "rustc").chmod(0o755)
    build = pathlib.Path(__file__).parent.parent / "web" / "build"
    path = {**os.environ, "PATH": f"{bare}:{os.environ['PATH']}", "RUSTC_WEB": str(bare / "none")}
    refused = subprocess.run([build, folder / "built"], env=path, capture_output=True, text=True, timeout=20)
    assert refused.returncode == 1 and "run 'rustup target add wasm32-unknown-unknown'" in refused.stderr, refused
    print("labels, generations, links, files and the limit of memory are right, and web/build names a missing compiler")


# Pairs of elements in different states or of different arms, and the property that must distinguish them.
STATES = [
    ("#modes button[aria-pressed=true]", "#modes button[aria-pressed=false]", "backgroundColor"),
    ('#credits button[data-credit="true 0"]', '#credits button[data-credit="true 1"]', "backgroundColor"),
    ("#train", "#undo", "backgroundColor"),
    ("#legend > :nth-child(1) .key", "#legend > :nth-child(2) .key", "color"),
    ('#credits [data-credit="sense 0"]', '#credits [data-credit="sense 1"]', "borderBottomColor"),
]


def check_contrasts(tab, dark, forced=False):
    """Tests that every text, border and mark of the page has enough contrast with its background."""
    palette = f"page.state.views[0].data.colors.{'dark' if dark else 'light'}"
    colours = tab.evaluate(COLOURS.replace("replay.data.colors[scheme]", palette))
    # With forced colours, disabled controls have faint text, which is allowed.
    disabled = "[...document.querySelectorAll(':disabled')].map(e => e.textContent.trim())"
    exempt = tab.evaluate(disabled) if forced else []
    for minimum, name, colour, background in colours:
        if name.removeprefix("border of ") not in exempt:
            ratio = contrast(colour, background)
            assert ratio >= minimum, (name, colour, background, ratio, dark)


def check_system_settings(tab, page, pictures):
    """Tests the page with forced colours, at 200 % zoom, and in a window of 1024 x 768."""
    def look(name, width, height, scale=1, dark=False, forced=False):
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        tab.call("Emulation.setDeviceMetricsOverride", **metrics)
        features = {"prefers-color-scheme": "dark" if dark else "light", "forced-colors": "active" if forced else ""}
        features = [{"name": key, "value": value} for key, value in features.items()]
        tab.call("Emulation.setEmulatedMedia", features=features)
        tab.load(page, layout="generally_forward", on="cpu", pace="full", **SMALL)
        tab.train()
        tab.set("#scrub", 6)
        tab.wait("page.state.views.every(view => view.data && view.data.episodes[0].generation === 6 && !view.playing)")
        tab.click('#credits button[data-credit="true 0"]')
        tab.evaluate("for (const part of document.querySelectorAll('details')) part.open = true; 0")
        tab.evaluate("document.activeElement.blur(); 0")
        scroll_width = tab.evaluate("document.documentElement.scrollWidth")
        assert scroll_width <= width, (name, "the page is wider than the window")
        # Only the editor may cut off long lines, because it scrolls.
        assert set(tab.evaluate(CUT)) <= {"text"}, (name, tab.evaluate(CUT))
        outside = (
            "[...document.querySelectorAll('main *')].filter(e => { const { width, right } = e.getBoundingClientRect();"
            f" return e.checkVisibility() && width && right > {width} + 0.5 && !e.closest('.stacks thead'); }})"
            ".map(e => e.id || e.textContent.slice(0, 30))"
        )
        assert tab.evaluate(outside) == [], (name, tab.evaluate(outside))
        check_contrasts(tab, dark, forced)
        tab.screenshot(pictures / f"web-{name}.png")
        tab.assert_no_errors()

    for dark in [False, True]:
        look(f"forced-{'dark' if dark else 'light'}", 1280, 900, dark=dark, forced=True)
        assert tab.evaluate("matchMedia('(forced-colors: active)').matches")
        for first, second, style in STATES:
            values = [
                tab.evaluate(f"getComputedStyle(document.querySelector({json.dumps(element)})).{style}")
                for element in (first, second)
            ]
            assert values[0] != values[1], (first, second, values)
        # The colours on a canvas need the page's own background, not the system's.
        for canvas, ground in [("#views canvas", "--sea"), ("#curves", "--card")]:
            own, actual = tab.evaluate(
                "(() => { const probe = document.createElement('i');"
                f" probe.style.cssText = 'forced-color-adjust: none; color: var({ground})';"
                " document.body.append(probe); const color = getComputedStyle(probe).color; probe.remove();"
                f" return [color, getComputedStyle(document.querySelector('{canvas}')).backgroundColor]; }})()"
            )
            assert own == actual, (canvas, own, actual)
    look("zoomed", 640, 450, scale=2)
    look("zoomed-forced", 640, 450, scale=2, forced=True)
    look("1024", 1024, 768)
    tab.window(1280, 900, dark=False)
    print("forced colours, 200 % zoom and a window of 1024 x 768 work")


# Valid TOML in other styles than that of the layouts.
TOML_STYLES = [
    "[ world ]\n# mine\nleaders = [[5, 5]]\nfollowers = [[4, 4], [6, 4]]\npois = [[5, 12]]\ncoupling = 2\n"
    "[ learning ] # also mine\nseed = 3 # a\n",
    "world = { leaders = [[5, 5]], followers = [[4, 4], [6, 4]], pois = [[5, 12]], coupling = 2 } # mine\n"
    "learning = { seed = 3 }\n",
    "# mine\nworld.leaders = [[5, 5]]\nworld.followers = [[4, 4], [6, 4]]\nworld.pois = [[5, 12]]\n"
    "world.coupling = 2\nlearning.seed = 3\n",
    "['world']\nleaders = [[5, 5]]\n\"followers\" = [[4, 4], [6, 4]] # mine\npois = [\n  [5, 12], # here\n]\n"
    "'coupling' = 2\n[\"learning\"]\n\"seed\" = 3\n",
]


def check_first_visit(tab, page, call, downloads):
    """Tests what a first-time visitor sees and uses: the opening, the guide, the gallery, and every control."""
    # The page opens with a trained team in motion, without waiting for a worker.
    def first_motion():
        tab.load(page)
        return tab.evaluate("performance.getEntriesByName('motion')[0].startTime")

    first = min(first_motion() for _ in range(3))
    # On a machine with many waiting processes, the time says nothing about the page.
    is_busy = os.getloadavg()[0] > 2 * os.cpu_count()
    assert first < 1000 or is_busy, f"the first motion comes after {first:.0f} ms"
    assert tab.evaluate("page.state.views[0].data.episodes[0].g") == 1
    assert not tab.evaluate("Boolean(page.state.training)")
    # Until the guide ends, the map is above the settings.
    above = "['#views', '#setup'].map(id => document.querySelector(id).getBoundingClientRect().top)"
    above = f"(([views, setup]) => views < setup)({above})"
    assert tab.evaluate(above)
    tab.click("#guide-end")
    assert not tab.evaluate(above)
    # After a change of settings, the map's title no longer names the trained team.
    title = "page.state.views[0].title.textContent"
    assert tab.evaluate(title).startswith("A trained team")
    tab.set("#seed", "8")
    tab.wait("page.state.config.learning.seed === '8'")
    tab.wait(f"{title} === 'Where everyone starts'")
    # Drive mode uses the map of the current settings.
    tab.click("[data-mode=drive]")
    tab.set("#coupling", "2")
    tab.wait("page.state.views[0].data.episodes[0].coupling[0] === 2")
    assert tab.evaluate("page.state.views[0].canvas.classList.contains('steer')")
    tab.load(page)
    # The guide removes the leader with the largest Df. The number of POIs that are lost equals its Df.
    episode = "page.state.views[0].data.episodes[0]"
    assert not tab.evaluate("document.querySelector('#guide').hidden")
    predict = "#guide-choices button"
    credits = tab.evaluate(f"{episode}.df")
    assert len(set(credits)) > 1, f"all leaders have the same credit: {credits}"
    tab.click(predict)
    leader = tab.evaluate("page.state.views[0].removed.leader")
    df = tab.evaluate(f"{episode}.df[{leader}]")
    lost = tab.evaluate(f"{episode}.without[{leader}].group.observed.filter(at => at === null).length")
    assert df > 0 and lost == round(df * 4), (df, lost)
    assert f"{lost} of 4 POIs are lost" in tab.text("#guide-says"), tab.text("#guide-says")
    assert "lost" in tab.text("#lost") and tab.text("#lost").endswith(f"its Df is {df:g}."), tab.text("#lost")
    assert tab.evaluate("document.activeElement.id") == "guide-next", "the focus is lost after a prediction"
    assert tab.text("#guide-says").startswith("You said: one. That is right. "), tab.text("#guide-says")
    # Then it trains both paradigms, and shows the baselines. Here, constant actions observe nothing. It does
    # not say why before the result is there.
    tab.click("#guide-next")
    assert tab.evaluate("document.activeElement.parentElement.id") == "guide-choices", "the focus is lost after Next"
    assert "Whose champions observe more" in tab.text("#guide-says") and not tab.evaluate("Boolean(page.state.training)")
    tab.click(predict)
    tab.wait("page.state.training && page.state.training.state === 'training'")
    assert "coincide" not in tab.text("#guide-says"), tab.text("#guide-says")
    tab.wait(DONE, 400)
    tab.wait("page.state.training.arms.every(arm => arm.random.length === 61)", 400)
    assert tab.evaluate("page.state.training.arms.map(arm => arm.constant)") == [0, 0]
    found = tab.evaluate("page.state.training.arms.map(arm => arm.trials.map(trial => trial.at(-1).champion))")
    tab.wait("document.querySelector('#guide-says').textContent.includes('Training is finished.')")
    guide = tab.text("#guide-says")
    assert f"Champions observe on average, of 4 POIs: {sum(found[0]):.2f} (leader-follower), 0.00 (all-leaders)." in guide, guide
    assert guide.startswith("You said: leader-follower. That is right. "), guide
    assert "Six independent learners almost never coincide" in guide, guide
    assert sum(found[0]) >= 3 and max(found[1]) == 0, found
    led = sum(found[0])
    assert not tab.text("#needless")
    random = tab.evaluate("page.state.training.arms[0].random")
    assert random == sorted(random) and random[-1] < sum(found[0]) / len(found[0]), random
    tab.assert_no_errors()
    # Larger populations observe more, and constant actions observe nothing.
    tab.click("#guide-next")
    tab.click(predict)
    tab.wait("page.state.training && page.state.training.arms.length === 3 && " + DONE, 400)
    tab.wait("page.state.training.arms.every(arm => arm.constant === 0)", 60)
    sums = "arm => arm.trials.reduce((sum, trial) => sum + trial.at(-1).champion, 0)"
    found = tab.evaluate(f"page.state.training.arms.map({sums})")
    assert found[0] < found[1] < 3 <= found[2], found
    tab.wait(f"document.querySelector('#guide-says').textContent.includes('{found[2]:.2f} (500 policies each)')")
    assert tab.text("#guide-says").startswith("You said: 20 are enough. It is: 500. "), tab.text("#guide-says")
    assert not tab.text("#needless")
    # With 20 policies, the best of as many random teams observes more, and the guide says so.
    tab.wait("page.state.training.arms[0].random.length === 61", 100)
    assert tab.evaluate("page.state.training.arms[0].random.at(-1) * 4") > found[0], found
    assert "training ends below mere luck" in tab.text("#guide-says"), tab.text("#guide-says")
    tab.assert_no_errors()
    # The whole population of three generations is shown, as 50 faint teams each. Random teams wait meanwhile.
    sums_random = "page.state.training.arms.reduce((sum, { random }) => sum + random.length, 0)"
    tab.evaluate(
        "window.randoms = []; const since = performance.now(), timer = setInterval(() => {"
        " if (!page.state.training) return clearInterval(timer);"
        f" if (performance.now() > since + 1000) randoms.push({sums_random});"
        " }, 20); document.querySelector('#guide-next').click(); 0"
    )
    tab.click(predict)
    assert tab.text("#guide-says").endswith(" The populations are being trained…"), tab.text("#guide-says")
    assert tab.evaluate("document.querySelector('#guide-next').disabled")
    tab.wait("page.state.views.length === 3 && page.state.views.every(view => view.ghosts.length === 50)", 100)
    assert len(set(tab.evaluate("randoms"))) <= 1, "random teams are played before what the guide waits for"
    # A link does not contain populations, and the page says so.
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("#share")
    tab.wait("window.copied")
    assert tab.text("#message").endswith("it has the settings, but not the teams on show."), tab.text("#message")
    # They are drawn once, so that the best team still moves. Drawing them for every picture took seconds.
    tab.wait("page.state.views.every(view => view.place >= 25)", 20)
    titles = tab.evaluate("page.state.views.map(view => view.title.textContent)")
    assert titles == ["Generation 0", "Generation 15", "Generation 60"], titles
    # The guide says where they go. Of each leader: the policies that stay near its start, and those that visit each POI.
    ways = (
        "page.state.views.map(({ ghosts, data: { pois, observation_radius } }) => [0, 1, 2, 3].map(leader => {"
        " const of = ({ episodes: [e] }) => Array.from(e.shown, (_, frame) => [0, 1].map(axis => e.positions[2 * (frame * e.agents + leader) + axis]));"
        " const near = ([x, y], radius) => way => way.some(place => Math.hypot(place[0] - x, place[1] - y) <= radius);"
        " const all = ghosts.map(of), start = way => way.every(place => Math.hypot(place[0] - way[0][0], place[1] - way[0][1]) < 6);"
        " return [all.filter(start).length, pois.map(poi => all.filter(near(poi, observation_radius)).length)]; }))"
    )
    early, middle, late = tab.evaluate(ways)
    assert all(stay > 25 for stay, _ in early), early
    assert [visits[1] for _, visits in middle[:2]] == [50, 50], middle
    assert all(visits[2] > 25 for _, visits in late), late
    tab.assert_no_errors()
    # The surprise: with one population per group, teams without followers learn, too.
    tab.click("#guide-next")
    tab.click(predict)
    tab.wait("page.state.training && page.state.training.arms[0].label === 'a population per agent' && " + DONE, 400)
    none, group, _ = tab.evaluate(f"page.state.training.arms.map({sums})")
    assert none == 0 and 2 <= group <= 3, (none, group)
    assert tab.text("#guide-says").startswith("You said: nothing. It is: two or three. "), tab.text("#guide-says")
    assert f"With followers it was {led:.2f}. " in tab.text("#guide-says"), (led, tab.text("#guide-says"))
    assert "shared policies do most of what followers do" in tab.text("#guide-says"), tab.text("#guide-says")
    # Agents of one population have one colour.
    tab.wait("page.state.views.length === 3 && page.state.views.every(view => view.data)")
    tints = "page.state.views.map(({ data }) => Array.from({ length: 12 }, (_, agent) => page.stage.tint(data, agent)))"
    assert [len(set(colors)) for colors in tab.evaluate(tints)] == [12, 4, 1], tab.evaluate(tints)
    owners = tab.evaluate("page.state.start.owner")
    of_group = tab.evaluate(tints)[1]
    assert all(of_group[agent] == of_group[owner] for agent, owner in enumerate(owners)), (of_group, owners)
    tab.evaluate("document.querySelector('#guide-next').focus(); document.querySelector('#guide-next').click()")
    assert tab.evaluate("document.querySelector('#guide').hidden")
    assert tab.evaluate("document.activeElement.id") == "train", "the focus is lost after the guide"
    tab.assert_no_errors()
    print(f"the opening and the guide work; first motion after {first:.0f} ms")

    # Every experiment of the gallery opens with its arms.
    names = tab.evaluate("[...document.querySelectorAll('[data-exhibit]')].map(button => button.dataset.exhibit)")
    assert len(names) == 9, names
    for name in names:
        tab.click(f"[data-exhibit={name}]")
        training = "page.state.training"
        tab.wait(f"{training} && {training}.state === 'training' && {training}.reached >= 0", 120)
        arms = tab.evaluate("page.state.training.arms.map(arm => arm.label)")
        assert len(arms) == len(set(arms)) >= 2, (name, arms)
        tab.assert_no_errors()
        tab.click("#stop")
        tab.wait("page.state.training.found")
    print("the experiments of the gallery open")

    # If a constant action is as good as training, the page says so.
    tab.load(page, layout="generally_forward", on="cpu", pace="full", **SMALL)
    tab.train()
    tab.wait("page.state.training.arms.every(arm => arm.random.length === 7)", 200)
    assert tab.evaluate("page.state.training.arms[0].constant") == 1
    assert tab.text("#needless").startswith("No learning is needed here."), tab.text("#needless")
    assert "and the best constant action 4.00" in tab.text("#needless"), tab.text("#needless")
    # The pointer on the chart shows the values of a generation.
    x, y = tab.evaluate(
        "(() => { const box = document.querySelector('#curves').getBoundingClientRect();"
        " return [box.left + 36 + (box.width - 50) / 3, box.top + 60]; })()"
    )
    mean = "page.state.training.arms[0].trials.reduce((sum, trial) => sum + trial[{}].champion, 0) / 2 * 4".format
    for at, move in [(2, [x, y]), (6, [x, y - 100])]:
        tab.mouse("mouseMoved", *move)
        tab.wait(f"document.querySelector('#legend').textContent.includes('at generation {at}.')")
        assert f"leader-follower: {tab.evaluate(mean(at)):.2f} of 4" in tab.text("#legend"), tab.text("#legend")
    # The keys have the dashes that are drawn.
    dashes = "[...document.querySelectorAll('#legend line')].map(line => line.getAttribute('stroke-dasharray'))"
    assert tab.evaluate(dashes) == ["", "7 3", "1.5 4", "6 3 1.5 3"], tab.evaluate(dashes)
    # The credit of every leader equals the share of POIs that are lost without it.
    tab.set("#scrub", 6)
    tab.wait("page.state.views.every(view => view.data && view.data.episodes[0].generation === 6)")
    wrong = tab.evaluate(
        "page.state.views.flatMap(({ data }) => { const [e] = data.episodes, pois = data.pois.length;"
        " const lost = part => e.observed.filter((at, poi) => at !== null && part.observed[poi] === null).length;"
        " return e.without.flatMap(({ alone, group }, leader) =>"
        " [[lost(alone) / pois, e.d[leader]], [lost(group) / pois, e.df[leader]]]); })"
        ".filter(([lost, credit]) => Math.abs(lost - credit) > 1e-6)"
    )
    assert wrong == [], wrong
    tab.click('#credits button[data-credit="true 0"]')
    assert tab.evaluate("page.state.views[0].removed") == {"leader": 0, "group": True}
    assert tab.evaluate("document.activeElement.dataset.credit") == "true 0", "the focus is lost"
    tab.click('#credits button[data-credit="true 0"]')
    assert tab.evaluate("page.state.views[0].removed") is None
    # A click on a leader in the map, or on its number, shows its inputs.
    tab.set("#step", 10)
    x, y = tab.evaluate(
        "(() => { const v = page.state.views[0]; v.canvas.scrollIntoView({ block: 'center' });"
        " const { X, Y } = page.stage.place_on(v.canvas, v.crop), box = v.canvas.getBoundingClientRect();"
        " return [box.left + X(v.drawn[1][0]) + 1, box.top + Y(v.drawn[1][1]) + 1]; })()"
    )
    tab.mouse("mousePressed", x, y)
    tab.mouse("mouseReleased", x, y)
    tab.wait("page.state.views[0].selected === 1")
    assert tab.text(".sensed").startswith("Leader 1 senses POIs: back right "), tab.text(".sensed")
    tab.click('#credits button[data-credit="sense 1"]')
    assert tab.evaluate("page.state.views[0].selected") is None
    # The player's controls: play, pause, speed, loop and heat map.
    pixels = "page.state.views[0].canvas.toDataURL().length"
    before = tab.evaluate(pixels)
    tab.click("#heat")
    assert tab.evaluate(pixels) != before
    tab.click("#heat")
    tab.set("#step", 0)
    tab.set("#speed", "0.25")
    tab.click("#replay")
    tab.wait("page.state.views.every(view => view.playing)")
    assert tab.text("#replay") == "Pause the episode"
    tab.click("#replay")
    place = tab.evaluate("page.state.views[0].place")
    assert place < 25 and not tab.evaluate("page.state.views[0].playing")
    tab.set("#speed", "4")
    tab.click("#replay")
    tab.wait("page.state.views[0].place === 25 && !page.state.views[0].playing")
    tab.click("#loop")
    tab.wait("page.state.views[0].playing && page.state.views[0].place < 25", 10)
    tab.click("#loop")
    tab.assert_no_errors()
    print("credits, inputs and the player's controls work")

    # Pictures, videos and a table can be saved.
    pictures = [("png", b"\x89PNG"), ("gif", b"GIF89a"), ("webm", b"\x1a\x45\xdf\xa3")]
    for button, start in pictures if LONG else pictures[:1]:
        tab.click(f"#{button}")
        content = downloaded(downloads / f"generally_forward-generation-6-trial-0.{button}")
        assert content.startswith(start) and len(content) > 5000, (button, len(content))
    tab.click("#csv")
    rows = downloaded(downloads / "generally_forward-curves.csv").decode().splitlines()
    assert rows[0] == "arm,trial,generation,best_g,mean_g,champion_g" and len(rows) == 1 + 2 * 2 * 7, rows[:3]
    tab.assert_no_errors()
    print("pictures, videos and curves are saved")

    # A link opens the same generation and trial of the same training.
    tab.set("#trial", "1")
    tab.set("#scrub", 3)
    tab.evaluate("navigator.clipboard.writeText = text => { window.copied = text; return Promise.resolve(); }; 0")
    tab.click("#share")
    tab.wait("window.copied")
    link, digests = tab.evaluate("window.copied"), tab.evaluate("page.state.training.arms.map(arm => arm.digest)")
    assert "generation=3" in link and "trial=1" in link and "play=1" in link and "version=" in link, link
    tab.open(link)
    tab.wait(READY)
    tab.wait(DONE)
    shown = "view.data && view.data.episodes[0].generation === 3 && view.data.episodes[0].trial === 1"
    tab.wait(f"page.state.views.every(view => {shown})")
    assert tab.evaluate("page.state.training.arms.map(arm => arm.digest)") == digests
    assert tab.text("#version") == ""
    tab.load(page, layout="chaotic", version="0.0.1")
    assert "version 0.0.1" in tab.text("#version"), tab.text("#version")
    print("a link contains generation, trial and version")

    # Five fitnesses are compared. Each arm's command gives its digest.
    tab.load(page, layout="strictly_forward", on="cpu", pace="full", learners="leader-follower", **SMALL)
    tab.set("#compare", "fitness")
    digests = tab.train()
    assert list(digests) == [f"trained with {fitness}" for fitness in ["G", "D", "Df", "D++", "Dt"]], digests
    arms = tab.evaluate("page.state.training.arms.map(({ command, digest }) => ({ command, digest }))")
    for index, arm in enumerate(arms):
        out = downloads / f"arm{index}"
        arguments = arm["command"].replace("configs/", f"{CONFIGS}/").split()[1:]
        call(*arguments, "--out", out, "--quiet", "--backend", "cpu")
        assert json.loads((out / "run.json").read_text())["digest"] == arm["digest"], arm
    assert "compare=learning.fitness" in tab.evaluate("location.hash")
    tab.click("#undo")
    assert tab.evaluate("page.state.compared") is None
    assert "with another config or comparison" in tab.text("#stale"), tab.text("#stale")
    # Settings in which the arms differ are not given as those of all arms.
    tab.set("#seed", "8")
    tab.wait("page.state.config.learning.seed === '8'")
    assert "with other settings: seed 7, population 20" in tab.text("#stale"), tab.text("#stale")
    tab.assert_no_errors()
    print("all fitnesses are compared, and each arm's command gives its digest")

    # The controls can edit any valid TOML, and keep its comments.
    for text in TOML_STYLES:
        tab.drop("mine.toml", base64(text.encode()))
        tab.wait(f"page.state.text === {json.dumps(text)} && page.state.valid")
        tab.set("#seed", "8")
        tab.wait("page.state.config.learning.seed === '8'")
        tab.set("#coupling", "3")
        tab.wait("page.state.config.world.coupling === 3")
        changed = tab.evaluate("page.state.text")
        assert changed.count("#") == text.count("#") and "mine" in changed, changed
        for key in ["seed", "coupling"]:
            assert changed.count(key) == 1, changed
        tab.assert_no_errors()
    print("the controls edit any valid TOML, and keep its comments")

    # On a phone, the maps follow directly after the settings, the bar with Train, and then the chart.
    tab.window(390, 844, dark=False)
    tab.load(page, layout="chaotic")
    tab.wait("page.state.views[0].data")
    more, train, views, play = tab.evaluate(
        "(() => { const box = selector => document.querySelector(selector).getBoundingClientRect();"
        " return [box('#more').bottom, box('#train').bottom, box('#views').top, box('#play').top]; })()"
    )
    assert more <= train <= views <= play and views - more < 100, (more, train, views, play)
    tab.window(1280, 900, dark=False)

    # With the pace "watch", the main thread draws few pictures during training. The time that they take depends on the
    # machine, so it is printed, but not tested.
    tab.load(page, layout="generally_forward", on="cpu")
    tab.evaluate(COUNT_DRAWN)
    tab.click("#train")
    training = "page.state.training"
    tab.wait(f"{training} && {training}.state === 'training' && {training}.reached >= 3")
    tab.evaluate("drawn.map = drawn.chart = 0")
    start = time.monotonic()
    tasks = tab.tasks(lambda: time.sleep(4))
    drawn, seconds = tab.evaluate("drawn"), time.monotonic() - start
    busy = sum(processor for _, processor in tasks) / 1000 / seconds
    assert 0 < drawn["map"] <= 2 * (32 * seconds + 5), (drawn, seconds)
    assert 0 < drawn["chart"] <= 4 * seconds + 3, (drawn, seconds)
    tab.click("#stop")
    tab.assert_no_errors()
    print(f"the main thread is busy for {busy:.0%} of a training; {drawn} pictures in {seconds:.1f} s")


def main():
    page, flotilla = (pathlib.Path(argument).resolve() for argument in sys.argv[1:3])
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        pictures = pathlib.Path(sys.argv[3]) if len(sys.argv) > 3 else folder
        pictures.mkdir(parents=True, exist_ok=True)

        def call(*arguments):
            command = [flotilla, *map(str, arguments)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

        def native(name, *arguments):
            """Trains with the program, and returns the digest."""
            out = folder / name
            call("train", *arguments, "--out", out, "--quiet", "--backend", "cpu")
            return json.loads((out / "run.json").read_text())["digest"]

        flags = [part for key, value in SMALL.items() for part in (f"--{key}", value)]
        layouts = ["generally_forward", "strictly_forward", "chaotic"]
        expected = {
            (layout, paradigm): native(
                f"{layout}-{paradigm}", CONFIGS / f"{layout}.toml", "--paradigm", paradigm, *flags
            )
            for layout, paradigm in itertools.product(layouts, ["leader-follower", "all-leaders"])
        }

        tab = Tab(folder / "profile", WEBGPU)
        tab.window(1280, 900, dark=False)
        downloads = folder / "downloads"
        downloads.mkdir()
        tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))

        # Training gives the program's digests, on the CPU and with WebGPU.
        for on, layout in itertools.product(["cpu", "gpu"], layouts):
            tab.load(page, layout=layout, on=on, pace="full", **SMALL)
            for paradigm, digest in tab.train().items():
                assert digest == expected[layout, paradigm], (on, layout, paradigm, digest)
            machine = tab.text("#machine")
            assert ("WebGPU" in machine and "exact" in machine) == (on == "gpu"), machine
            assert on == "gpu" or "SIMD128" in machine, machine
            tab.assert_no_errors()
            print(f"{layout} on {on}: the program's digests")

        # Verify reports equal results with the exactness pass, and different ones without.
        tab.click("#verify")
        tab.wait("!document.querySelector('#verify').disabled", 400)
        assert tab.text("#verified").startswith("Equal: "), tab.text("#verified")
        tab.click("#plain")
        tab.click("#verify")
        tab.wait("!document.querySelector('#verify').disabled", 400)
        assert tab.text("#verified").startswith("DIFFERENT: "), tab.text("#verified")
        tab.assert_no_errors()
        print("Verify detects a missing pass")

        # If the GPU is lost during training, the page says so. Training again gives the same digest.
        tab.load(page, layout="chaotic", on="gpu", pace="full", **SMALL)
        tab.set("#generations", "100000")
        tab.wait("page.state.config.learning.generations === 100000")
        tab.click("#train")
        tab.wait("page.state.training && page.state.training.reached >= 1")
        tab.lose_gpu()
        tab.wait("document.querySelector('#trouble').textContent.includes('Train again')")
        tab.set("#generations", str(SMALL["generations"]))
        tab.wait(f"page.state.config.learning.generations === {SMALL['generations']}")
        assert tab.train()["leader-follower"] == expected["chaotic", "leader-follower"]
        print("a lost GPU is reported, and training works again")

        # Training can be paused, and earlier generations can be viewed.
        tab.load(page, on="cpu", layout="generally_forward")
        tab.click("#train")
        tab.wait("page.state.training && page.state.training.reached >= 5")
        tab.click("#pause")
        reached = tab.evaluate("page.state.training.reached")
        time.sleep(0.5)
        assert tab.evaluate("page.state.training.reached") <= reached + 2, "training does not pause"
        tab.set("#scrub", 3)
        shown = "page.state.views.map(view => view.data && view.data.episodes[0].generation)"
        tab.wait(f"{shown}.every(generation => generation === 3)")
        tab.set("#trial", "2")
        tab.wait("page.state.views.every(view => view.data.episodes[0].trial === 2)")
        tab.wait("page.state.views.every(view => view.data.episodes[0].generation === 3)")
        scored = "page.state.training.arms.map(arm => arm.trials[2][3].champion)"
        played = "page.state.views.map(view => view.data.episodes[0].team_g)"
        assert tab.evaluate(scored) == tab.evaluate(played), "the episode shown has another G than the training"
        tab.click("#pause")
        tab.wait(DONE)
        tab.assert_no_errors()
        print("training pauses and resumes, and generations can be viewed")

        # After a POI is dragged, training gives the program's digest for the new map.
        tab.click("[data-mode=arrange]")
        x, y = tab.place("pois", 0)
        tab.mouse("mousePressed", x, y)
        tab.mouse("mouseMoved", x + 30, y - 20)
        tab.mouse("mouseReleased", x + 30, y - 20)
        tab.wait("document.querySelector('#layout').value === 'own'")
        moved = tab.evaluate("page.state.config.world.pois[0]")
        assert moved != [10, 15] and moved[0] > 10, moved
        tab.set("#coupling", "2")
        tab.wait("page.state.config.world.coupling === 2")
        tab.set("#generations", "12")
        tab.set("#pace", "full")
        tab.wait("page.state.config.learning.generations === 12")
        own = tab.train()
        config = folder / "own.toml"
        config.write_text(tab.evaluate("page.state.text"))
        assert "# " in config.read_text(), "the config lost its comments"
        assert own["leader-follower"] == native("own", config, "--paradigm", "leader-follower")
        # Agents can be moved with the keyboard.
        tab.click("[data-mode=arrange]")
        tab.evaluate("page.state.views[0].canvas.focus()")
        tab.press("]", "BracketRight")
        before = tab.evaluate("page.state.config.world.leaders[0]")
        tab.press("ArrowRight", "ArrowRight")
        tab.wait(f"page.state.config.world.leaders[0][0] === {before[0] + 1}")
        tab.assert_no_errors()
        print("a map is edited, and training gives the program's digest")

        # A link contains the edited config.
        tab.evaluate("document.querySelector('#message').textContent = ''")
        tab.click("#share")
        tab.wait("/copied|not let a page copy/.test(document.querySelector('#message').textContent)")
        link, text = tab.evaluate("location.href"), tab.evaluate("page.state.text")
        tab.open(link)
        tab.wait(READY)
        opened = tab.evaluate("page.state.text")
        assert opened == text, "\n".join(difflib.unified_diff(text.splitlines(), opened.splitlines(), lineterm=""))
        print("a link contains the experiment")

        # In drive mode, followers follow the driven leader, and its target POI is observed.
        tab.load(page, layout="generally_forward", on="cpu", pace="full", **SMALL)
        tab.train()
        tab.click("[data-mode=drive]")
        tab.click("#again")
        tab.mouse("mouseMoved", *tab.place("pois", 0))
        tab.wait("document.querySelector('#driven').textContent.includes('Yours: D = ')")
        episode = "page.state.views[0].data.episodes[0]"
        steps = tab.evaluate(f"{episode}.shown.length")
        assert steps == 26, steps
        near = tab.evaluate(f"[...{episode}.near.slice(-4)]")
        assert near[0] >= 3, f"leader 0 was driven to POI 0, but the agents near the POIs are {near}"
        tab.assert_no_errors()
        print("a leader is driven, and its followers follow")

        # A saved run can be plotted, replayed and resumed by the program, and opened again.
        tab.load(page, layout="strictly_forward", on="cpu", pace="full", **SMALL)
        digests = tab.train()
        tab.click(".home")
        archive = downloads / "strictly_forward-leader-follower.zip"
        downloaded(archive)
        run = folder / "home"
        with zipfile.ZipFile(archive) as files:
            names = files.namelist()
            assert {name.split("/")[0] for name in names} == {"strictly_forward-leader-follower"}, names
            files.extractall(run)
        run = run / "strictly_forward-leader-follower"
        assert json.loads((run / "run.json").read_text())["digest"] == digests["leader-follower"]
        call("plot", run, "--out", folder / "curves.svg")
        call("replay", run, "--out", folder / "replay.html", "--backend", "cpu")
        resume = ("--resume", "--generations", "9", "--quiet", "--backend", "cpu")
        call("train", run / "config.toml", "--out", run, *resume)
        longer = native("longer", run / "config.toml")
        assert json.loads((run / "run.json").read_text())["digest"] == longer, "the resumed run has another digest"
        tab.load(page)
        tab.drop("run.zip", base64(archive.read_bytes()))
        tab.wait("document.querySelector('#message').textContent.includes('its digest matches')")
        assert tab.text(".sha") == digests["leader-follower"]
        tab.wait("page.state.views[0].data.episodes[0].generation === 6")
        tab.set("#scrub", 2)
        tab.wait("page.state.views[0].data.episodes[0].generation === 2")
        with zipfile.ZipFile(archive) as files:
            policies = files.read("strictly_forward-leader-follower/policies.safetensors")
        tab.drop("policies.safetensors", base64(policies))
        tab.wait("document.querySelector('#message').textContent.includes('Take a leader')")
        tab.assert_no_errors()
        # An incomplete run, and files of other kinds, give an error and change nothing.
        half = folder / "half.zip"
        with zipfile.ZipFile(archive) as files, zipfile.ZipFile(half, "w") as to:
            for name in files.namelist():
                if not name.endswith("run.json"):
                    to.writestr(name, files.read(name))
        incomplete, picture = ("half.zip", half.read_bytes(), "run.json"), ("curves.png", b"\x89PNG", "not a config")
        for name, content, message in [incomplete, picture]:
            tab.drop(name, base64(content))
            tab.wait(f"document.querySelector('#trouble').textContent.includes({json.dumps(message)})")
            tab.evaluate("document.querySelector('#trouble').textContent = ''")
        assert tab.evaluate("page.state.policies !== null")
        assert not list(tab.complaints())
        print("a run is saved, resumed by the program, and opened again")

        # A value that was entered just before Train is used. Seeds above 2^53 are exact.
        tab.load(page, layout="strictly_forward", on="cpu", pace="full", learners="leader-follower", **SMALL)
        seed = 2**53 + 1
        tab.evaluate(
            f"(() => {{ const e = document.querySelector('#seed'); e.value = '{seed}';"
            " e.dispatchEvent(new Event('change', { bubbles: true }));"
            " document.querySelector('#setup').requestSubmit(); })()"
        )
        tab.wait(DONE)
        flags = [part for key, value in {**SMALL, "seed": seed}.items() for part in (f"--{key}", value)]
        entered = native("entered", CONFIGS / "strictly_forward.toml", *flags)
        assert tab.text(".sha") == entered, "training did not use the entered seed"
        assert str(seed) in tab.evaluate("location.href")
        assert tab.evaluate("document.querySelector('#seed').value") == str(seed)
        tab.assert_no_errors()
        print("the last entered values are used")

        # Configs can be opened. The problems of a broken one are marked at their lines.
        tab.drop("mine.toml", base64(b"[world]\nleaders = [[5, 5]]\nfollowers = [[4, 4], [6, 4]]\npois = [[5, 12]]\n"))
        tab.wait("page.state.config.world.leaders.length === 1 && document.querySelector('#layout').value === 'own'")
        tab.assert_no_errors()
        tab.drop("stages.toml", base64(STAGED.encode()))
        tab.wait("(page.state.config.stages || []).length === 1")
        staged = folder / "stages.toml"
        staged.write_text(STAGED)
        assert tab.train()["leader-follower"] == native("stages", staged), "stages give another digest than the program"
        assert "Share of POIs" in tab.text("#legend"), tab.text("#legend")
        tab.assert_no_errors()
        tab.drop("broken.toml", base64(b"[world]\nleaders = [[5, 5]]\npois = [[5, 120]]\nstep = 3\n"))
        tab.wait("document.querySelectorAll('#problems li').length === 2")
        problems = tab.text("#problems")
        assert "Line 3: world.pois[0][1]" in problems and "Line 4: world.step" in problems, problems
        assert tab.evaluate("document.querySelector('#train').disabled")
        assert tab.evaluate("[...document.querySelectorAll('.mark')].map(mark => mark.style.top)") == ["48px", "68px"]
        assert not list(tab.complaints())
        print("configs are opened, and problems are marked at their lines")

        check_several_runs(tab, page, flotilla, folder / "several")
        check_slow_network(tab, page)
        check_map_in_view(tab, page)
        check_history(tab, page)
        check_classes(tab, page, native, folder)
        check_consistency(tab, page, downloads)
        check_links_and_devices(tab, page)
        check_first_visit(tab, page, call, downloads)
        check_former_defects(tab, page, call, downloads, folder)
        if LONG:
            check_system_settings(tab, page, pictures)

        # The page stays responsive while it trains 4096 teams. The observer of long tasks measures elapsed time, which
        # includes other programs, so the test uses the thread's processor time.
        tab.load(page, layout="generally_forward", on="cpu", pace="full", trials=1, generations=6, population=4096)
        tab.evaluate(
            "window.long = []; new PerformanceObserver(list => long.push(...list.getEntries().map(e => e.duration)))"
            ".observe({ type: 'longtask' }); 0"
        )
        tasks = tab.tasks(lambda: tab.train(600))
        tab.assert_no_errors()
        long, busiest = tab.evaluate("long"), max(processor for _, processor in tasks)
        assert len(tasks) > 100 and busiest < 50, (len(tasks), busiest, long)
        print(
            f"while 4096 teams train, the longest of {len(tasks)} tasks takes {busiest:.0f} ms of processor time;"
            f" {len(long)} tasks take longer than 50 ms"
        )

        # Screenshots at three sizes, in light and dark mode, with checks of widths, contrasts and labels.
        looks = list(itertools.product([(390, 844), (820, 1180), (1440, 900)], [False, True]))
        settings, generation = ({"seed": 1}, 100) if LONG else (SMALL, SMALL["generations"])
        for (width, height), dark in looks if LONG else looks[:1]:
            tab.window(width, height, dark)
            tab.load(page, layout="generally_forward", on="cpu", pace="full", **settings)
            tab.train()
            tab.set("#scrub", generation)
            at_end = f"view.data.episodes[0].generation === {generation} && !view.playing"
            tab.wait(f"page.state.views.every(view => {at_end})")
            assert tab.evaluate("document.documentElement.scrollWidth") <= width, "the page is wider than the window"
            assert not tab.evaluate(CUT), f"cut off at width {width}: {tab.evaluate(CUT)}"
            check_contrasts(tab, dark)
            unnamed = tab.evaluate(
                "[...document.querySelectorAll('button, select, input, canvas, textarea')]"
                ".filter(e => e.checkVisibility() && !(e.textContent.trim() || e.getAttribute('aria-label')"
                " || (e.labels && e.labels.length))).map(e => e.outerHTML)"
            )
            assert not unnamed, unnamed
            tab.assert_no_errors()
            tab.screenshot(pictures / f"web-{width}-{'dark' if dark else 'light'}.png")
        tab.close()
        print("the page fits its windows, with enough contrast")


if __name__ == "__main__":
    main()
