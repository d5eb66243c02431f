"""The page in a browser, with all it complained of and asked for."""

import io

import numpy as np
from PIL import Image as PillowImage

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # The 3D views need WebGL; without a graphics card Chromium draws it in software only when told so.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


class Witness:
    """An opened page with all it complained of and asked for."""

    def __init__(self, browser, path, width, *, drawn, script="", **context):
        self.errors = []
        self.requests = []
        self.context = browser.new_context(viewport={"width": width, "height": 900}, **context)
        self.page = self.context.new_page()
        if script:
            self.page.add_init_script(script)
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", self._dialog)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        for name in drawn:
            self.page.wait_for_selector(f"#{name}[data-drawn]", timeout=60_000)

    def _dialog(self, dialog):
        self.errors.append(f"dialog {dialog.message}")
        dialog.dismiss()

    def pixels(self, selector):
        """(H, W, 3) of an element as it is shown."""
        shot = self.page.locator(selector).screenshot()
        return np.asarray(PillowImage.open(io.BytesIO(shot)).convert("RGB"))
