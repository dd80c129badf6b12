"""A headless Chromium that is led by its developer tools: what a page says, shows, draws and fetches."""

import base64
import json
import shutil
import subprocess
import urllib.request
from contextlib import contextmanager
from time import monotonic

import cv2
import numpy as np
import pytest

from tests.patience import PATIENCE_S

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
QUIET = ("--headless=new", "--no-sandbox", "--no-first-run", "--window-size=1000,800")


@contextmanager
def opened(url, profile):
    """A page of a browser of its own, whose profile is kept in a folder; skips the test without a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser found among {', '.join(BROWSERS)}; `apt-get install chromium` brings one")
    connect = pytest.importorskip("websockets.sync.client").connect
    command = [browser, *QUIET, *SOFTWARE_WEBGL, f"--user-data-dir={profile}", "--remote-debugging-port=0", "about:blank"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        line = next(line for line in process.stderr if "DevTools listening on" in line)
        port = line.split("://")[1].partition("/")[0]
        with urllib.request.urlopen(f"http://{port}/json") as answer:
            target = next(target for target in json.load(answer) if target["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=None) as socket:
            page = Page(socket)
            page.open(url)
            yield page
    finally:
        process.terminate()
        process.wait(20)
        process.stderr.close()


class Page:
    """A page, and what has happened on it."""

    def __init__(self, socket):
        self._socket, self._calls, self.events = socket, 0, []

    def open(self, url):
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=url)

    def call(self, method, **parameters):
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while (message := json.loads(self._socket.recv())).get("id") != self._calls:
            self.events.append(message)
        return message.get("result", message)

    def run(self, script):
        """Value of a script."""
        return self.call("Runtime.evaluate", expression=script, awaitPromise=True)["result"].get("value")

    def until(self, holds, seconds=PATIENCE_S):
        """Wait until a function of the page gives neither None nor False, and give its value."""
        end = monotonic() + seconds
        while (value := holds(self)) is None or value is False:
            assert monotonic() < end, f"waited in vain; the page says: {self.run('document.body.innerText')}"
            self.run("new Promise(resolve => setTimeout(resolve, 100))")
        return value

    def picture(self):
        """What is seen : (h, w, 3) BGR."""
        shot = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)

    @property
    def complaints(self):
        """Errors of console, scripts and network."""
        found = [event["params"] for event in self.events if event.get("method") == "Runtime.exceptionThrown"]
        for event in self.events:
            said = event.get("params", {})
            if event.get("method") == "Runtime.consoleAPICalled" and said["type"] == "error":
                found.append(said["args"])
            elif event.get("method") == "Log.entryAdded" and said["entry"]["level"] == "error":
                found.append(said["entry"])
        return found

    @property
    def fetched(self):
        """Addresses of all requests, but those of data in the page itself."""
        requests = [event["params"] for event in self.events if event.get("method") == "Network.requestWillBeSent"]
        addresses = [request["request"]["url"] for request in requests]
        return [address for address in addresses if not address.startswith(("data:", "blob:"))]
