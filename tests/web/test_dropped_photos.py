"""Loose pictures dropped on the page become one capture of the service, bit for bit, and a build of it waits."""

import base64
import io

import numpy as np
from PIL import Image
from playwright.sync_api import expect

from tests.web.conftest import Viewer, wait_until

DROP = """(photographs) => {
  const files = new DataTransfer();
  for (const [name, base64] of photographs) {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    files.items.add(new File([bytes], name, { type: 'image/jpeg' }));
  }
  for (const type of ['dragenter', 'dragover', 'drop'])
    document.body.dispatchEvent(new DragEvent(type, { dataTransfer: files, bubbles: true, cancelable: true }));
}"""


def jpeg(seed: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)).save(file, "JPEG")
    return file.getvalue()


def test_loose_pictures_are_one_capture(viewer: Viewer) -> None:
    pictures = {f"IMG_{number}.JPG": jpeg(number) for number in range(9)}
    viewer.page.evaluate(DROP, [[name, base64.b64encode(data).decode()] for name, data in pictures.items()])
    jobs = wait_until(lambda: [job for job in viewer.server.ask("/api/jobs")["jobs"] if job["name"] == "photographs"], "the build")
    card = viewer.page.get_by_role("listitem", name="Build photographs")
    expect(card).to_be_visible()
    kept = viewer.server.data / "uploads" / jobs[0]["id"]
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == pictures
    card.get_by_role("button", name="Cancel").click()
    card.get_by_role("button", name="Remove").click()
    expect(card).to_have_count(0)
