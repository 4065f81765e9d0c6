"""`--tev`: pictures on the way, sent to a small server that speaks tev's protocol."""

import socket
import struct
import threading

import manylights
import numpy as np
import pytest
from manylights.cli.main import parser
from manylights.errors import UsageError

from tests.conftest import require_variant
from tests.test_images import scene

pytestmark = pytest.mark.usefixtures("plugin")

CREATE, UPDATE = 4, 6

#: A packet without content, which only these tests send.
LAST = struct.pack("<I", 4)


class FakeTev:
    """Takes images as tev does, in a thread.

    Attributes:
        images: by name, shape (height, width, channels).
        updates: how many packets have changed them.
    """

    def __init__(self):
        self.images, self.updates = {}, 0
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def close(self):
        """Take all that was sent, then listen no more."""
        if self.thread.is_alive():
            with socket.create_connection(self.socket.getsockname()) as last:
                last.sendall(LAST)
            self.thread.join(10)
        self.socket.close()

    def _serve(self):
        packet = None
        while packet != b"":
            connection, _ = self.socket.accept()
            with connection:
                while packet := self._packet(connection):
                    self._take(packet)

    @staticmethod
    def _packet(connection):
        def take(count):
            found = b""
            while len(found) < count and (more := connection.recv(count - len(found))):
                found += more
            return found

        length = take(4)
        return take(struct.unpack("<I", length)[0] - 4) if length else None

    def _take(self, packet):
        kind, at = packet[0], 2  # and whether to come to the front
        name, at = self._text(packet, at)
        if kind == CREATE:
            width, height, count = struct.unpack_from("<3i", packet, at)
            self.images[name] = np.zeros((height, width, count), np.float32)
        elif kind == UPDATE:
            (count,) = struct.unpack_from("<i", packet, at)
            at += 4
            for _ in range(count):
                _, at = self._text(packet, at)
            x, y, width, height = struct.unpack_from("<4i", packet, at)
            at += 16 + 16 * count
            pixels = np.frombuffer(packet, "<f4", width * height * count, at)
            shape = (height, width, count)
            self.images[name][y : y + height, x : x + width] = pixels.reshape(shape)
            self.updates += 1

    @staticmethod
    def _text(packet, at):
        end = packet.index(b"\0", at)
        return packet[at:end].decode(), end + 1


@pytest.fixture
def tev():
    pytest.importorskip("tevclient", reason="tevclient is not installed")
    server = FakeTev()
    yield server
    server.close()


def test_each_step_is_shown(tev, tmp_path, monkeypatch):
    require_variant("scalar_rgb")
    monkeypatch.setattr("manylights.rendering.plan.SINGLE_STEP_SAMPLES", 1)
    monkeypatch.setitem(manylights.rendering.plan.MOST_SAMPLES, "scalar", 16 * 12 * 4)
    result = manylights.render(scene(), spp=12, output=tmp_path / "a.exr", tev=tev.address)
    tev.close()
    assert tev.updates == 3
    np.testing.assert_allclose(tev.images["a.exr"], result.image[..., :3], rtol=1e-5)


def test_large_pictures_come_in_tiles(tev):
    require_variant("scalar_rgb")
    wide = scene()
    wide["camera"]["film"] |= {"width": 200, "height": 130}
    result = manylights.render(wide, spp=1, tev=tev.address)
    tev.close()
    np.testing.assert_allclose(tev.images["manylights"], result.image[..., :3], rtol=1e-5)


def test_a_viewer_that_is_closed_does_not_stop_the_render(capsys):
    pytest.importorskip("tevclient", reason="tevclient is not installed")
    require_variant("scalar_rgb")
    server = FakeTev()
    result = manylights.render(
        scene(), spp=1, tev=server.address, progress=lambda _: server.close()
    )
    assert result.samples == 1 and capsys.readouterr().err.count("the render goes on without") == 1


def test_no_viewer_is_named():
    pytest.importorskip("tevclient", reason="tevclient is not installed")
    require_variant("scalar_rgb")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(UsageError, match=rf"tev 127.0.0.1:{port}: nobody listens .*start tev"):
        manylights.render(scene(), spp=1, tev=f"127.0.0.1:{port}")
    with pytest.raises(UsageError, match="tev here:port: must be HOST:PORT"):
        manylights.render(scene(), spp=1, tev="here:port")


def test_what_to_install_is_named(monkeypatch):
    require_variant("scalar_rgb")
    monkeypatch.setitem(__import__("sys").modules, "tevclient", None)
    with pytest.raises(UsageError, match=r"tevclient, type: pip install 'manylights\[tev\]'"):
        manylights.render(scene(), spp=1, tev="")


def test_the_command_takes_an_address_or_none():
    parsed = parser().parse_args(["render", "a.xml", "-o", "a.exr", "--tev"])
    assert parsed.tev == ""
