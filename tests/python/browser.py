"""A headless Chromium, driven by its own protocol (DevTools): opens pages, runs script in them, takes pictures."""
import base64
import contextlib
import json
import re
import subprocess
import threading
import urllib.request

from websockets.sync.client import connect


def started(command, address):
    """The process of a browser, and what it says of its address."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    found = next(match.group(1) for match in map(re.compile(address).search, process.stderr) if match)
    # A full pipe would stop the browser.
    threading.Thread(target=process.stderr.read, daemon=True).start()
    return process, found


class Browser:
    """One page; `messages` are the events that came so far."""

    def __init__(self, program, profile):
        options = ["--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--enable-unsafe-swiftshader", f"--user-data-dir={profile}"]
        self.process, port = started([program, *options, "about:blank"], r"ws://127\.0\.0\.1:(\d+)/")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        self.connection = contextlib.ExitStack()
        self.socket = self.connection.enter_context(connect(page["webSocketDebuggerUrl"], max_size=None))
        self.messages, self.number = [], 0
        for domain in ("Runtime", "Page", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=120))
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message["result"]
            self.messages.append(message)

    def script(self, text):
        """The value of an expression in the page; waits for promises."""
        result = self.call("Runtime.evaluate", expression=text, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def open(self, path, width, height=900, dark=False):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        theme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media="", features=[theme])
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.script("new Promise(done => { const wait = () => document.readyState === 'complete' ? done(1) : setTimeout(wait, 20); wait(); })")
        self.drawn()

    def drawn(self):
        """Waits until what was changed is on the screen."""
        self.script("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def press(self, key, shift=False):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, modifiers=8 if shift else 0)
        self.drawn()

    def picture(self):
        """PNG of what is on the screen."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def complaints(self):
        """Errors and warnings in the console, and requests that left the page."""
        def bad(message):
            method, parameters = message["method"], message["params"]
            if method == "Network.requestWillBeSent":
                return not parameters["request"]["url"].startswith(("file:", "data:", "about:"))
            if method == "Log.entryAdded":
                entry = parameters["entry"]
                # How fast this machine's driver is says nothing of the page.
                return entry["level"] in ("error", "warning") and "GL Driver Message" not in entry["text"]
            return (method == "Runtime.exceptionThrown"
                    or (method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert")))
        return [message for message in self.messages if bad(message)]

    def close(self):
        self.connection.close()
        self.process.terminate()
        self.process.wait(timeout=30)
