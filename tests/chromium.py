"""A real Chromium without a window, driven by its own protocol: pages, clicks, keys, files and pictures."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PATIENCE = 120.0  # s, for a page to show what is waited for


class Tab:
    """One page of the browser."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._count = 0
        self.events: list[dict[str, Any]] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == self._count:
                assert "error" not in message, (method, message["error"])
                return dict(message.get("result", {}))
            self.events.append(message)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def reload(self) -> None:
        """Loads the page again; where it asks whether to leave what is not saved, yes."""
        self.call("Page.reload")
        time.sleep(0.3)
        with suppress(AssertionError):  # it did not ask
            self.call("Page.handleJavaScriptDialog", accept=True)

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression, a promise's too."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, script: str) -> Any:
        """The value of an expression as soon as it is true."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                if found := self.run(script):
                    return found
            except AssertionError:  # the page is on its way
                pass
            time.sleep(0.1)
        raise AssertionError(f"waited in vain for {script}; the page shows: {self.text()[:2000]}")

    def wait_for(self, text: str) -> None:
        """Until the page shows ``text``."""
        self.wait(f"document.body?.innerText.includes({json.dumps(text)})")

    def text(self) -> str:
        return str(self.run("document.body?.innerText ?? ''"))

    def place(self, script: str) -> tuple[float, float]:
        """The middle of the element that an expression gives, on the screen."""
        self.run(f"({script}).scrollIntoView({{block: 'nearest'}})")
        x, y = self.run(f"(() => {{ const b = ({script}).getBoundingClientRect();"
                        " return [b.x + b.width / 2, b.y + b.height / 2]; })()")  # fmt: skip
        return x, y

    def click(self, text: str) -> None:
        """Clicks the link or button that shows ``text``."""
        found = (
            "[...document.querySelectorAll('button, a, [role=button]')]"
            f".find((e) => e.innerText.trim() === {json.dumps(text)} && e.offsetParent && !e.disabled)"
        )
        self.wait(f"!!{found}")
        self.drag(self.place(found))

    def drag(self, *places: tuple[float, float]) -> None:
        """Presses the mouse at the first place, moves through the others and lets go at the last."""
        self.mouse("mouseMoved", places[0])
        self.mouse("mousePressed", places[0])
        for place in places[1:]:
            self.mouse("mouseMoved", place)
        self.mouse("mouseReleased", places[-1])

    def mouse(self, kind: str, place: tuple[float, float]) -> None:
        button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], **button)

    def key(self, key: str, modifiers: int = 0) -> None:
        """Presses a key; ``modifiers`` 2 is Ctrl, 8 Shift."""
        codes = {"Enter": 13, "Escape": 27, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
        code = codes.get(key, ord(key.upper()[0]))
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code, modifiers=modifiers)

    def choose_files(self, selector: str, *files: Path) -> None:
        """Gives ``files`` to the file input that ``selector`` finds."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def drop_files(self, script: str, *files: Path) -> None:
        """Drags ``files`` from elsewhere onto the element that an expression gives."""
        x, y = self.place(script)
        data = {"items": [], "files": [str(file) for file in files], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=x, y=y, data=data)

    def size(self, width: int, height: int, dark: bool = False) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=features)

    def picture(self, file: Path) -> None:
        shot = self.call("Page.captureScreenshot", format="png")
        file.write_bytes(base64.b64decode(shot["data"]))

    def complaints(self) -> list[str]:
        """Errors of scripts, and whatever else the browser's console shows as one."""
        found = []
        for event in self.events:
            parameters = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(str(parameters["exceptionDetails"]))
            elif event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
                found.append(f"{parameters['entry']['text']} {parameters['entry'].get('url', '')}")
        return found

    def addresses(self) -> set[str]:
        """Everything that the pages asked for."""
        sent = (e["params"]["request"]["url"] for e in self.events if e.get("method") == "Network.requestWillBeSent")
        return set(sent)


@contextmanager
def browser(folder: Path) -> Iterator[Any]:
    """A browser with its profile in ``folder``; what it gives opens tabs."""
    from websockets.sync.client import connect

    quiet = ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", *quiet, "--remote-debugging-port=0"]
    command += [f"--user-data-dir={folder}", "about:blank"]
    told = folder / "DevToolsActivePort"
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process, ExitStack() as sockets:
        try:
            end = time.monotonic() + PATIENCE
            while not (told.is_file() and "\n" in told.read_text()):
                assert process.poll() is None and time.monotonic() < end, "the browser did not start"
                time.sleep(0.1)
            port = int(told.read_text().split()[0])

            def tab() -> Tab:
                ask = urllib.request.Request(f"http://127.0.0.1:{port}/json/new?about:blank", method="PUT")
                with urllib.request.urlopen(ask) as answer:
                    where = json.load(answer)["webSocketDebuggerUrl"]
                # A tab that nobody reads for a while answers no ping, and must not be closed for it; nor may what waits
                # to be read be limited, or the answer to a close waits behind it in vain.
                link = connect(where, max_size=None, max_queue=None, ping_interval=None)
                return Tab(sockets.enter_context(link))

            yield tab
        finally:
            sockets.close()
            process.terminate()
