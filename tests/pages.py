"""What the tests of pages share: a parser that finds outside references, a browser."""

import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest


class Page(HTMLParser):
    """Collects what a page could load, its ids, and its data blocks."""

    VOID = ("meta", "link", "input", "br", "img")

    def __init__(self, text):
        super().__init__()
        self.references, self.ids, self.tags, self.blocks = [], [], [], []
        self.open, self.title, self.unclosed = [], "", []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "action", "data"):
                self.references.append(value or "")
            if name == "id":
                self.ids.append(value)
        if tag == "script" and ("type", "application/json") in attrs:
            self.blocks.append("")
        if tag not in self.VOID:
            self.open.append((tag, attrs))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if self.open and self.open[-1][0] == tag:
            self.open.pop()
        else:
            self.unclosed.append(tag)

    def handle_data(self, data):
        if not self.open:
            return
        tag, attrs = self.open[-1]
        if tag == "script" and ("type", "application/json") in attrs:
            self.blocks[-1] += data
        if tag == "title" and "svg" not in [name for name, _ in self.open]:
            self.title += data


def reject_constant(name):
    raise ValueError(name)


def check_page(text):
    """The page is whole, loads nothing, and its data are strict JSON."""
    page = Page(text)
    for reference in page.references:
        assert reference.startswith(("data:", "#")), reference[:80]
    assert not re.search(r"https?://", text)
    for address in re.findall(r"url\(\s*['\"]?([^)]*)", text):
        assert address.startswith(("#", "data:")), address[:80]
    assert not re.search(r"@import|\bimport\s*\(|fetch\(|XMLHttpRequest", text)
    assert len(page.ids) == len(set(page.ids))
    assert page.open == []
    assert page.unclosed == []
    for block in page.blocks:
        json.loads(block, parse_constant=reject_constant)
    fragments = [ref[1:] for ref in page.references if ref.startswith("#")]
    assert set(fragments) <= set(page.ids)
    return page


def chromium():
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next((path for name in names if (path := shutil.which(name))), None)
    if found is None:
        message = f"none of {', '.join(names)} is on PATH"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


def browse(tmp_path, page, *flags, address="#replay"):
    """Opens a page without a network; returns its final DOM and the browser's log."""
    command = [
        chromium(), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking",
        "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
        "--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9",
        f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr",
        "--window-size=1200,3000", "--virtual-time-budget=4000", *flags,
        "--dump-dom", page.as_uri() + address,
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, done.stderr
