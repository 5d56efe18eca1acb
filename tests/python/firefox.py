"""A headless Firefox, driven by WebDriver BiDi: opens pages, runs script in them, takes pictures."""
import base64
import contextlib
import json

from browser import started
from websockets.sync.client import connect


class Firefox:
    """One page; `complaints` are the errors and warnings of its console so far."""

    def __init__(self, program, profile):
        options = ["--headless", "--no-remote", "--remote-debugging-port=0", "--profile", str(profile)]
        self.process, address = started([program, *options], r"WebDriver BiDi listening on (ws://\S+)")
        self.connection = contextlib.ExitStack()
        self.socket = self.connection.enter_context(connect(f"{address}/session", max_size=None))
        self.complaints, self.number = [], 0
        self.call("session.new", capabilities={})
        self.page = self.call("browsingContext.getTree")["contexts"][0]["context"]
        self.call("session.subscribe", events=["log.entryAdded"])

    def call(self, method, **parameters):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=120))
            if message.get("id") == self.number:
                assert message["type"] == "success", message
                return message["result"]
            if message.get("method") == "log.entryAdded" and message["params"]["level"] in ("error", "warn"):
                self.complaints.append(message["params"]["text"])

    def script(self, text):
        """The value of an expression in the page, by way of JSON; waits for promises."""
        wrapped = f"Promise.resolve(eval({json.dumps(text)})).then(value => JSON.stringify(value ?? null))"
        answer = self.call("script.evaluate", expression=wrapped, target={"context": self.page}, awaitPromise=True)
        assert answer["type"] == "success", answer
        return json.loads(answer["result"]["value"])

    def open(self, path, width, height=900):
        self.call("browsingContext.setViewport", context=self.page, viewport={"width": width, "height": height})
        self.call("browsingContext.navigate", context=self.page, url=path.resolve().as_uri(), wait="complete")
        self.drawn()

    def drawn(self):
        """Waits until what was changed is on the screen."""
        self.script("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def picture(self):
        """PNG of what is on the screen."""
        return base64.b64decode(self.call("browsingContext.captureScreenshot", context=self.page)["data"])

    def close(self):
        self.connection.close()
        self.process.terminate()
        self.process.wait(timeout=30)
