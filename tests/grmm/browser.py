"""A browser for tests: speaks the viewer's websocket, without a screen."""

from contextlib import ExitStack

import msgspec
import numpy as np
from websockets.sync.client import connect

from express50.files.images import decode_image


class Browser:
    """Receives every message; keeps the controls by label and the newest picture."""

    def __init__(self, page):
        self.open = ExitStack()
        address = page.replace("http://", "ws://").removesuffix("/")  # as the page's script does
        self.socket = self.open.enter_context(connect(address, max_size=None, compression=None))
        self.controls, self.picture, self.pictures = {}, None, 0

    def close(self):
        self.open.close()

    def send(self, kind, **content):
        self.socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def look(self, position, look_at=(0.0, 0.0, 0.0), aspect=1.0, fov=0.5):
        forward = np.array(look_at) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        from express50.geometry.transforms import matrix_to_quat

        turn = np.stack([right, np.cross(forward, right), forward], 1)
        self.send(
            "ViewerCameraMessage", wxyz=[float(x) for x in matrix_to_quat(turn)],
            position=[float(x) for x in position], fov=fov, near=0.01, far=100.0, aspect=aspect,
            look_at=[float(x) for x in look_at], up_direction=[0.0, 1.0, 0.0],
        )  # fmt: skip

    def move(self, label, value):
        self.send("GuiUpdateMessage", uuid=self.controls[label], updates={"value": value})

    def listen(self, pictures, seconds=20.0):
        """Take messages until so many more pictures have come."""
        wanted = self.pictures + pictures
        while self.pictures < wanted:
            for message in msgspec.msgpack.decode(self.socket.recv(timeout=seconds)):
                label = (message.get("props") or {}).get("label")
                if message["type"].startswith("Gui") and label and "uuid" in message:
                    self.controls[label] = message["uuid"]
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                    self.picture = decode_image(bytes(message["rgb_data"]))
                    self.pictures += 1
        return self.picture

    def settle(self, height):
        """The next picture of this height: that of a head at rest, after any that move."""
        while self.listen(1).shape[0] != height:
            pass
        return self.picture.astype(int)
