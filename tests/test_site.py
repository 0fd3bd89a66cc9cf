"""The documents build as a site, strictly and from what is here: every page in the menu, every link and every name of the API found."""

import html
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE_SECONDS

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert result.returncode == 0, result.stderr + result.stdout
    return folder


@pytest.mark.slow
def test_the_readme_is_the_first_page(site: Path):
    page = (site / "index.html").read_text()
    assert "Two commands" in page and 'href="protocol.html"' in page and 'src="images/sample.jpg"' in page


@pytest.mark.slow
def test_every_command_is_described_as_it_describes_itself(site: Path):
    page = (site / "commands.html").read_text()
    assert all(f"Usage: drgs {name} " in page for name in ("build", "render", "import", "export", "simulate", "eval", "doctor", "serve"))


@pytest.mark.slow
def test_no_line_of_a_commands_help_is_cut_by_its_box(site: Path):
    from docs.gather_pages import WIDTH

    blocks = re.findall(r"<code>(.*?)</code></pre>", (site / "commands.html").read_text(), re.DOTALL)
    lines = [html.unescape(re.sub("<[^>]+>", "", line)) for block in blocks for line in block.splitlines()]
    assert len(lines) > 100 and [line for line in lines if len(line) > WIDTH] == []


@pytest.mark.slow
def test_pages_lead_on_to_the_next(site: Path):
    page = (site / "tutorial.html").read_text()
    assert re.search(r'rel="prev".*?rel="next"', page, re.DOTALL) and "md-footer__link--next" in page


def test_the_api_has_every_public_name():
    import drgs

    described = set(re.findall(r"^::: [\w.]*?(\w+)$", (ROOT / "docs" / "api" / "library.md").read_text(), re.MULTILINE))
    assert described | {"__version__", "Client"} == set(drgs.__all__)


@pytest.mark.slow
def test_the_client_is_described_with_what_it_does(site: Path):
    assert "drgs_server.client.Client.open_session" in (site / "api" / "client.html").read_text()


@pytest.mark.slow
def test_pages_load_nothing_from_elsewhere(site: Path):
    for path in site.rglob("*.html"):
        loaded = re.findall(r"<(?:script|img|link)[^>]*?(?:src|href)=[\"']?(https?:[^\"' >]+)", path.read_text())
        assert [address for address in loaded if "canonical" not in address] == [], path.name
