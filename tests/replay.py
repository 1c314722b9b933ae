"""Tests replay pages in headless Chromium.

    python3 tests/replay.py FLOTILLA [FOLDER]

Pages must load, play and scrub, and show the positions that `flotilla rollout --trace` writes. Their contrasts must
meet WCAG AA in light and dark mode. Screenshots are written to FOLDER.

Needs Python's standard library and Chromium, which $CHROMIUM may name. The test controls the browser with the DevTools
protocol over a pipe.
"""

import base64
import itertools
import json
import os
import pathlib
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time

CONFIG = """
[world]
map = [30.0, 20.0]
leaders = [[8.0, 5.0], [20.0, 5.0]]
followers = [[9.0, 3.0], [7.0, 3.0], [21.0, 3.0], [19.0, 3.0]]
pois = [[8.0, 10.0], [20.0, 10.0]]
coupling = 2
steps = 25
[learning]
population = 2
generations = 30
trials = 1
"""
STEPS, AGENTS = 25, 6


class Browser:
    """A headless Chromium with one page."""

    def __init__(self, profile, flags=("--disable-gpu",)):
        names = ["chromium", "chromium-browser", "google-chrome"]
        program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
        if program is None:
            sys.exit("no Chromium found; install one, or name it with $CHROMIUM")
        read_commands, self.commands = os.pipe()
        self.answers, write_answers = os.pipe()

        def pipes():
            # Chromium reads commands from file descriptor 3 and answers on 4. If the pipes have one of these numbers,
            # they are moved first, so that neither overwrites the other.
            low, high = os.dup(read_commands), os.dup(write_answers)
            low, high = (os.dup(low), os.dup(high)) if 3 in (low, high) or 4 in (low, high) else (low, high)
            os.dup2(low, 3)
            os.dup2(high, 4)

        arguments = ["--headless", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-pipe", *flags]
        self.process = subprocess.Popen(
            [program, *arguments, f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=pipes, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        os.close(read_commands)
        os.close(write_answers)
        self.buffer, self.count, self.events = b"", 0, []
        self.session = None
        pages = [page for page in self.call("Target.getTargets")["targetInfos"] if page["type"] == "page"]
        target = {"targetId": pages[0]["targetId"], "flatten": True}
        self.session = self.call("Target.attachToTarget", **target)["sessionId"]
        for domain in ["Page", "Runtime", "Log", "Network"]:
            self.call(f"{domain}.enable")

    def message(self, seconds=120):
        deadline = time.monotonic() + seconds
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.answers], [], [], max(0, deadline - time.monotonic()))
            chunk = os.read(self.answers, 1 << 16) if ready else b""
            if not chunk:
                raise TimeoutError("Chromium does not answer")
            self.buffer += chunk
        text, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(text)

    def call(self, method, **parameters):
        self.count += 1
        command = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            command["sessionId"] = self.session
        os.write(self.commands, json.dumps(command).encode() + b"\0")
        while (message := self.message()).get("id") != self.count:
            self.events.append(message)
        if "error" in message:
            raise RuntimeError(f"{method}: {message['error']}")
        return message["result"]

    def open(self, url):
        # Open an empty page first, because a change of the fragment alone would not reload the page.
        for address in ["about:blank", url]:
            self.events.clear()
            self.call("Page.navigate", url=address)
            while not any(event["method"] == "Page.loadEventFired" for event in self.events):
                self.events.append(self.message())

    def evaluate(self, script):
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def press(self, key, code):
        for kind in ["keyDown", "keyUp"]:
            text = " " if key == " " and kind == "keyDown" else ""
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, text=text)

    def click(self, selector):
        box = f"(() => {{ const b = document.querySelector('{selector}').getBoundingClientRect();"
        x, y = self.evaluate(box + " return [b.x + b.width / 2, b.y + b.height / 2]; })()")
        for kind in ["mousePressed", "mouseReleased"]:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def wait(self, script, seconds=120):
        deadline = time.monotonic() + seconds
        while not self.evaluate(script):
            assert time.monotonic() < deadline, f"timeout while waiting for: {script}"
            time.sleep(0.02)

    def window(self, width, height, dark):
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def screenshot(self, path):
        content = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(content["data"]))

    def complaints(self):
        """Yields errors and warnings of the page, and its requests to the network."""
        for event in self.events:
            method, parameters = event.get("method"), event.get("params", {})
            if method == "Runtime.exceptionThrown":
                yield parameters["exceptionDetails"]["text"]
            elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
                yield str(parameters["args"])
            elif method == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
                yield parameters["entry"]["text"]
            elif method == "Network.requestWillBeSent":
                url = parameters["request"]["url"]
                if not url.startswith(("file:", "data:", "blob:")):
                    yield f"request for {url}"

    def close(self):
        self.call("Browser.close")
        self.process.wait(20)


# Returns rows of required contrast, description, colour and background: for texts, borders of controls, and the canvas.
COLOURS = """(() => {
  const parse = text => text.match(/[\\d.]+/g).map(Number);
  const background = element => {
    for (let at = element; at; at = at.parentElement) {
      const color = parse(getComputedStyle(at).backgroundColor);
      if (color.length === 3 || color[3] === 1) return color.slice(0, 3);
    }
    return [255, 255, 255];
  };
  const rows = [];
  for (const element of document.querySelectorAll("body *")) {
    if (!element.checkVisibility() || element.closest("script")) continue;
    const style = getComputedStyle(element);
    const text = [...element.childNodes].filter(node => node.nodeType === 3).map(node => node.data.trim()).join("");
    if (text) rows.push([4.5, text.slice(0, 30), parse(style.color).slice(0, 3), background(element)]);
    if (element.matches("button, select")) {
      rows.push([3, "border of " + text, parse(style.borderTopColor).slice(0, 3), background(element.parentElement)]);
    }
  }
  const root = getComputedStyle(document.documentElement);
  const hex = text => [1, 3, 5].map(at => parseInt(text.slice(at, at + 2), 16));
  const named = name => {
    const text = root.getPropertyValue(name).trim();
    return hex(text.length === 4 ? "#" + [...text.slice(1)].map(c => c + c).join("") : text);
  };
  const sea = named("--sea");
  rows.push([4.5, "labels on the map", named("--ink"), sea]);
  for (const name of ["--seen", "--poi", "--ink"]) rows.push([3, name, named(name), sea]);
  const scheme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  for (const color of replay.data.colors[scheme]) rows.push([3, "leader " + color, hex(color), sea]);
  return rows;
})()"""


def contrast(a, b):
    """Returns WCAG's contrast ratio of two sRGB colours."""
    def luminance(color):
        shares = [channel / 255 for channel in color]
        linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    low, high = sorted([luminance(a), luminance(b)])
    return (high + 0.05) / (low + 0.05)


def every_team(source, target):
    """Writes a file of policies with every team that can be formed from the policies of a run's first trial."""
    content = source.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    tensor = header["weights.0"]
    leaders, policies, parameters = tensor["shape"]
    start, size = tensor["data_offsets"][0], 4 * parameters
    teams = list(itertools.product(range(policies), repeat=leaders))
    weights = b""
    for leader in range(leaders):
        for team in teams:
            at = start + (leader * policies + team[leader]) * size
            weights += body[at : at + size]
    shape = [leaders, len(teams), parameters]
    header = json.dumps({"weights": {"dtype": "F32", "shape": shape, "data_offsets": [0, len(weights)]}}).encode()
    target.write_bytes(struct.pack("<Q", len(header)) + header + weights)


def traces(path):
    """Returns the positions of each team, [steps + 1][agents] of [x, y], rounded to f32."""
    single = lambda text: struct.unpack("<f", struct.pack("<f", float(text)))[0]
    teams = {}
    for line in path.read_text().splitlines()[1:]:
        team, step, agent, _, x, y, *_ = line.split(",")
        steps = teams.setdefault(int(team), [[None] * AGENTS for _ in range(STEPS + 1)])
        steps[int(step)][int(agent)] = [single(x), single(y)]
    return list(teams.values())


def main():
    flotilla = str(pathlib.Path(sys.argv[1]).resolve())
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        pictures = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else folder
        pictures.mkdir(parents=True, exist_ok=True)
        run, config = folder / "run", folder / "small.toml"
        config.write_text(CONFIG)

        def call(*arguments):
            subprocess.run([flotilla, *map(str, arguments), "--backend", "cpu"], check=True, stdout=subprocess.DEVNULL)

        call("train", config, "--out", run, "--quiet")
        call("replay", run)
        call("replay", run, "--compare", "0", "--out", folder / "compare.html")
        every_team(run / "policies.safetensors", folder / "all.safetensors")
        call("rollout", run / "config.toml", "--policies", folder / "all.safetensors", "--trace", folder / "trace.csv")

        browser = Browser(folder / "profile")
        browser.window(1280, 900, dark=False)
        browser.open((run / "replay.html").as_uri())
        browser.wait("document.readyState === 'complete' && replay.step === 0")

        # Scrub through all steps. The positions on the screen must equal the trace of a team bit by bit.
        scrub = (
            "(() => {{ const s = document.querySelector('#scrub'); s.value = {};"
            " s.dispatchEvent(new Event('input')); }})()"
        )
        shown, counts = [], []
        for step in range(STEPS + 1):
            browser.evaluate(scrub.format(step))
            assert browser.evaluate("replay.step") == step
            shown.append(browser.evaluate("replay.positions[0]"))
            header = browser.evaluate("document.querySelector('.episode header p').textContent")
            counts.append(int(header.split()[0]))
        assert shown in traces(folder / "trace.csv"), "the page's positions are those of no team"
        assert counts == sorted(counts) and counts[0] == 0, counts
        assert counts[-1] == 2 * browser.evaluate("replay.data.episodes[0].g") > 0, counts

        # The table of POIs has the number of agents near each POI. Pointing at a POI on the map selects it.
        cells = "[...document.querySelectorAll('table:last-of-type td:nth-child(3)')]"
        near, last = f"{cells}.map(cell => Number(cell.textContent))", STEPS * 2
        expected = f"[...replay.data.episodes[0].near.slice({last}, {last} + 2)]"
        assert browser.evaluate(near) == browser.evaluate(expected)
        for poi in range(2):
            x, y = browser.evaluate(f"replay.place(0, {poi})")
            browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
            browser.wait(f"replay.pointed[0] === {poi}")

        # The page has keyboard shortcuts.
        browser.press("Home", "Home")
        assert browser.evaluate("replay.step") == 0
        browser.press("ArrowRight", "ArrowRight")
        assert browser.evaluate("replay.step") == 1
        browser.press("ArrowLeft", "ArrowLeft")
        assert browser.evaluate("replay.step") == 0
        browser.press("+", "Equal")
        assert browser.evaluate("document.querySelector('#speed').value") == "2"
        browser.press(" ", "Space")
        assert browser.evaluate("replay.playing")
        browser.wait("replay.step > 3")

        # A paused replay does not move. A playing one stops at the last step.
        browser.click("#play")
        assert not browser.evaluate("replay.playing")
        step = browser.evaluate("replay.step")
        time.sleep(0.3)
        assert browser.evaluate("replay.step") == step
        browser.click("#play")
        browser.wait(f"replay.step === {STEPS} && !replay.playing")
        assert not list(browser.complaints()), list(browser.complaints())

        # Pages with one and with two generations, in large and small windows, in light and dark mode.
        for page, name in [(run / "replay.html", "one"), (folder / "compare.html", "two")]:
            for (width, height), dark in itertools.product([(1280, 900), (1000, 800), (390, 844)], [False, True]):
                browser.window(width, height, dark)
                browser.open(page.as_uri() + "#step=18")
                browser.wait("document.readyState === 'complete' && replay.step === 18")
                scroll_width = browser.evaluate("document.documentElement.scrollWidth")
                assert scroll_width <= width, "the page is wider than the window"
                tables = "[...document.querySelectorAll('.scores')].every(table => table.scrollWidth <= table.clientWidth)"
                assert width < 1000 or browser.evaluate(tables), "a table scrolls sideways"
                assert browser.evaluate("document.querySelectorAll('canvas').length") == (2 if name == "two" else 1)
                assert not list(browser.complaints()), list(browser.complaints())
                colours = browser.evaluate(COLOURS)
                assert len(colours) > 60, colours
                for minimum, name_of_colour, colour, background in colours:
                    ratio = contrast(colour, background)
                    assert ratio >= minimum, (name_of_colour, colour, background, ratio, dark)
                label = browser.evaluate("document.querySelector('canvas').getAttribute('aria-label')")
                assert label.startswith("Map of generation ") and "step 18: " in label, label
                browser.screenshot(pictures / f"{name}-{width}-{'dark' if dark else 'light'}.png")
        # Arrow keys in a table scroll it. In a low window, the controls do not cover the map.
        key = "new KeyboardEvent('keydown', { key: 'ArrowRight', bubbles: true, cancelable: true })"
        scrolls = f"document.querySelector('.scores').dispatchEvent({key})"
        assert browser.evaluate(scrolls) and browser.evaluate("replay.step") == 18
        position = "getComputedStyle(document.querySelector('#controls')).position"
        assert browser.evaluate(position) == "sticky"
        browser.window(640, 400, dark=False)
        assert browser.evaluate(position) == "static"
        browser.close()
        print("replay pages load without errors, play, scrub, and show the traces of rollout")


if __name__ == "__main__":
    main()
