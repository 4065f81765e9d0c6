"""Shows a render in the viewer tev while it goes on, with the package tevclient."""

from __future__ import annotations

from manylights.errors import UsageError, argument
from manylights.output import channels
from manylights.progress import say
from manylights.rendering.develop import picture
from manylights.rendering.state import State

#: Where tev listens if it is not told otherwise.
HOST, PORT = "localhost", 14158

MISSING = "needs the package tevclient, type: pip install 'manylights[tev]'"


def check(address: str) -> None:
    """Raise ``UsageError`` if the address is none or tevclient is missing; nobody is asked."""
    _parse(address)
    _client()


def _client():
    try:
        from tevclient import Ipc
    except ImportError as error:
        raise UsageError(f"{argument('tev')}: {MISSING}") from error
    return Ipc


class Viewer:
    """A picture in tev.

    Attributes:
        address: host and port.
        name: of the picture.
        works: does tev still listen? A render goes on without.
    """

    def __init__(self, address: str, name: str) -> None:
        """Connect once, to see whether tev is there.

        Args:
            address: ``HOST:PORT``, ``HOST``, or empty for this machine.
            name: to show the picture under.

        Raises:
            UsageError: tevclient is not installed, no such address, or nobody listens.
        """
        self.address, self.name, self.works = _parse(address), name, True
        self.made = False
        try:
            with self._connection():
                pass
        except OSError as error:
            host, port = self.address
            reason = error.strerror or error
            raise UsageError(
                f"{argument('tev')} {host}:{port}: nobody listens ({reason}), start tev"
            ) from error

    def show(self, state: State, adjoint: bool, exposure: float) -> None:
        """Send the colours of what there is so far."""
        if not self.works:
            return
        image = picture(state.rough_total(adjoint), state.channels)
        chosen = channels.colors_in(state.channels)
        if chosen is None:
            return
        pixels = image[..., [state.channels.index(name) for name in chosen]]
        height, width, count = pixels.shape
        names = list(channels.RGB if count == 3 else chosen)
        try:
            with self._connection() as tev:
                if not self.made:
                    tev.create_image(self.name, width, height, names)
                self.made = True
                tev.update_image(self.name, pixels * exposure, names)
        except OSError as error:
            self.works = False
            say(f"tev: does not answer ({error.strerror or error}), the render goes on without")

    def _connection(self):
        return _client()(*self.address)


def _parse(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":") if ":" in address else (address, "", "")
    number = int(port) if port.isdigit() else PORT
    if colon and (not port.isdigit() or not 0 < number < 65536):
        raise UsageError(
            f"{argument('tev')} {address}: must be HOST:PORT with a port from 1 to 65535"
        )
    return host or HOST, number
