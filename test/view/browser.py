# SPDX-License-Identifier: Apache-2.0
"""Control of a headless Chromium by the DevTools protocol, for tests."""

import base64
import itertools
import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
OPTIONS = (
    '--headless=new',
    '--no-sandbox',
    '--no-first-run',
    '--disable-dev-shm-usage',
    '--disable-background-networking',
    '--enable-unsafe-swiftshader',
    '--use-angle=swiftshader',
    '--remote-debugging-port=0',
    '--remote-allow-origins=*',
    '--hide-scrollbars',
)
DEADLINE = 120.0  # longest wait for the browser [s]
#: script that lowers the frame rate, because drawing without a graphics card occupies a core
SLOWLY = """
const soon = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (draw) => setTimeout(() => soon(draw), 1000);
"""
#: script that notes the text of each button that receives a click
NOTE_PRESSED = """
document.addEventListener('click', (event) => {
  const button = event.target.closest('button');
  if (button) window.pressed = button.innerText.trim();
}, true);
"""
#: expression for all text on the page, without that in shadow trees
TEXT = 'document.body ? document.body.innerText : ""'


def find_chromium() -> str | None:
    """Return the path of an installed Chromium; None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A headless Chromium with one tab."""

    def __init__(self, profile: Path, url: str, size: tuple[int, int] = (1024, 640)) -> None:
        """Start Chromium and open the page `url` in a window of `size` [pixels]."""
        self._url = url
        program = find_chromium()
        assert program is not None
        window = f'--window-size={size[0]},{size[1]}'
        self._process = subprocess.Popen(
            [program, *OPTIONS, window, f'--user-data-dir={profile}', 'about:blank'],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            port_file = profile / 'DevToolsActivePort'
            self._wait(lambda: port_file.exists() and port_file.read_text().count('\n') == 1)
            port, path = port_file.read_text().splitlines()
            self._socket = connect(f'ws://127.0.0.1:{port}{path}', max_size=None)
            self._numbers, self._session = itertools.count(1), None
            tab = self._wait(self._find_tab)
            attached = self.call('Target.attachToTarget', targetId=tab, flatten=True)
            self._session = attached['sessionId']
            self.call('Page.enable')
            for script in SLOWLY, NOTE_PRESSED:
                self.call('Page.addScriptToEvaluateOnNewDocument', source=script)
            self.visit(size)
        except BaseException:
            self._process.kill()
            raise

    def visit(self, size: tuple[int, int]) -> None:
        """Open the page anew, in a window of `size` [pixels]."""
        metrics = {'deviceScaleFactor': 1, 'mobile': False}
        self.call('Emulation.setDeviceMetricsOverride', width=size[0], height=size[1], **metrics)
        self.call('Page.navigate', url=self._url)

    def _find_tab(self) -> str | None:
        targets = self.call('Target.getTargets')['targetInfos']
        return next((each['targetId'] for each in targets if each['type'] == 'page'), None)

    @staticmethod
    def _wait(condition: Any, what: str = 'the browser') -> Any:
        end = time.monotonic() + DEADLINE
        while not (value := condition()):
            assert time.monotonic() < end, f'timeout after {DEADLINE:g} s: {what}'
            time.sleep(0.05)
        return value

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol."""
        message = {'id': next(self._numbers), 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=DEADLINE))
            if answer.get('id') == message['id']:
                # An error is no failure: while a page is loading, no expression can be evaluated.
                return answer.get('result') or {'result': {}, 'error': answer.get('error')}

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        done = self.call('Runtime.evaluate', expression=expression, returnByValue=True)
        return done['result'].get('value')

    @property
    def text(self) -> str:
        """All text on the page."""
        return self.evaluate(TEXT) or ''

    def wait_for(self, text: str) -> None:
        """Wait until the page shows a text."""
        self._wait(lambda: text in self.text, f'{text!r} on the page')

    def mouse(self, kind: str, x: float, y: float, pressed: bool = False) -> None:
        """Send a mouse event to (x, y): mouseMoved, mousePressed or mouseReleased (left button)."""
        button = 'left' if kind != 'mouseMoved' or pressed else 'none'
        self.call(
            'Input.dispatchMouseEvent',
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=int(pressed),
            clickCount=int(kind != 'mouseMoved'),
        )

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        """Press the left button at `start` and move to `end`; keep the button pressed."""
        self.mouse('mouseMoved', *start)
        self.mouse('mousePressed', *start, pressed=True)
        for i in range(1, steps + 1):
            at = [a + (b - a) * i / steps for a, b in zip(start, end)]
            self.mouse('mouseMoved', *at, pressed=True)
            time.sleep(0.06)

    def press(self, button: str) -> None:
        """Press the button with the text `button`, by the keyboard.

        A click could miss the button, because it moves whenever the readings above it need more or
        fewer lines.
        """
        focus = (
            '(() => { const b = [...document.querySelectorAll("button")].find('
            f'b => b.innerText.trim() === {json.dumps(button)}); if (!b) return false;'
            'b.scrollIntoView({block: "center"}); b.focus(); return true; })()'
        )

        def is_pressed() -> bool:
            if self.evaluate(focus):
                for kind in 'keyDown', 'keyUp':
                    key = {'key': 'Enter', 'code': 'Enter', 'windowsVirtualKeyCode': 13}
                    self.call('Input.dispatchKeyEvent', type=kind, text='\r', **key)
            return self.evaluate('window.pressed') == button

        self.evaluate('window.pressed = null')
        self._wait(is_pressed, f'the button {button}')

    def type_at(self, slider: str, text: str) -> None:
        """Replace the number in the box of the slider with the label `slider`, key by key."""
        find = (
            '(() => { const label = [...document.querySelectorAll("label")].find('
            f'each => each.innerText.trim() === {json.dumps(slider)}); if (!label) return false;'
            'let row = label, box = null; while (row && !box) { row = row.parentElement;'
            'box = row && row.querySelector("input.mantine-NumberInput-input"); }'
            'if (!box) return false;'
            'box.scrollIntoView({block: "center"}); box.focus(); box.select(); return true; })()'
        )
        self._wait(lambda: self.evaluate(find), f'the number box of {slider}')
        for key in text:
            self.call('Input.insertText', text=key)

    def close_notifications(self) -> None:
        """Close notifications that cover the arm, such as a warning of a missing graphics card."""
        button = '.mantine-Notification-closeButton'
        self.evaluate(f'document.querySelectorAll("{button}").forEach(each => each.click())')
        time.sleep(0.5)

    def screenshot(self, file: Path) -> bytes:
        """Save a screenshot as a PNG file, and return its bytes."""
        data = base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])
        file.write_bytes(data)
        return data

    def close(self) -> None:
        """End the browser."""
        try:
            self._session = None
            self.call('Browser.close')
            self._process.wait(timeout=10)
        except Exception:  # noqa: BLE001 - however it ends, it ends
            self._process.kill()
            self._process.wait()
        self._socket.close()
