"""The memory of a workbench that has made hundreds of previews."""

import http.client
import json
import math

import psutil
import pytest

from tests.app.conftest import SMALL

FIRST, LAST = 30, 300  # previews at which the memory is read
GROWTH = 1.2  # largest allowed ratio of the two


class Browser:
    """A page of the workbench: its cookie, and requests that send JSON."""

    def __init__(self, own):
        self._host = own.root.removeprefix("http://")
        self._token = own.address.partition("token=")[2]

    def ask(self, path, table):
        """The answer to a POST, as JSON."""
        port = self._host.rpartition(":")[2]
        connection = http.client.HTTPConnection(self._host, timeout=120)
        connection.request("POST", path, json.dumps(table), {"Cookie": f"bstcad-{port}={self._token}"})
        answer = connection.getresponse()
        data = answer.read()
        connection.close()
        assert answer.status == 200, data
        return json.loads(data)


def sizes(number):
    """Control points and pixels of a preview; no two in a row are alike."""
    points, pixels = 33 + 29 * number % 137, [16 + 13 * number % 53, 16 + 31 * number % 47]
    text = SMALL.replace("control_points = 65", f"control_points = {points}")
    return text.replace("pixels = 48", f"pixels = {pixels}")


@pytest.mark.bench
def test_memory_stays_after_hundreds_of_previews_of_changing_sizes(served):
    browser, process = Browser(served), psutil.Process(served.process.pid)
    memory = {}
    for number in range(1, LAST + 1):
        browser.ask("/api/scene/small/change", {"text": sizes(number)})
        while not (answer := browser.ask("/api/scene/small/preview", {"page": "a", "number": number})):
            pass  # kernels compile
        assert answer["stage"] == "preview" and math.isfinite(answer["seconds"]), answer
        memory[number] = process.memory_info().rss / 1e6
        if number % 30 == 0:
            print(f"{number} previews: {memory[number]:.0f} MB")
    assert max(list(memory.values())[FIRST:]) < GROWTH * memory[FIRST], memory
