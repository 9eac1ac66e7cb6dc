"""Observations in memory that a server on the same machine shares, in place of the socket.

The memory has slots, which the server writes in turn. With `copy`, an observation is copied out of its slot. Without,
its arrays are views of the slot, which the server writes again three observations later. So that no array changes
while it is in use, the client sends no request for an observation whose slot has arrays that still exist: it raises
`SlotInUse` instead.
"""

from __future__ import annotations

import gc
import mmap
import os
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ConnectFailed, ProtocolError, SlotInUse
from .messages import InMemory, SharedMemoryOffer
from .protocol import OBSERVATION_BYTES

PROOF_BYTES = 1024
"""Longest proof that is read."""


class SharedMemory:
    """Memory that a server shares with this client. Raises `ConnectFailed` if it cannot be opened."""

    def __init__(self, offer: SharedMemoryOffer, copy: bool) -> None:
        self._copy = copy
        self._size = offer.slots * offer.slot_bytes
        self._next = 0
        self._slots = [_Slot() for _ in range(offer.slots)]
        self._descriptor, self.proof = _open(offer)
        weakref.finalize(self, os.close, self._descriptor)

    def check_next_slot(self) -> None:
        """Raises `SlotInUse` if the slot that the server writes next has arrays that still exist."""
        if self._copy:
            return
        slot = self._slots[self._next]
        if slot.is_in_use():
            # Objects that refer to each other live until the collector finds them.
            gc.collect()
        if slot.is_in_use():
            raise SlotInUse(
                f"the next observation overwrites the one that is {len(self._slots)} before it, of which arrays "
                "still exist: copy what is to be kept, or connect without copy=False"
            )

    def read(self, place: InMemory) -> bytes | memoryview:
        """The bytes of a message."""
        if place.slot != self._next:
            raise ProtocolError(f"the server wrote slot {place.slot}; slot {self._next} was its turn")
        if place.bytes > OBSERVATION_BYTES or place.offset + place.bytes > self._size:
            raise ProtocolError(f"{place.bytes} bytes at {place.offset} are outside of the shared memory")
        self._next = (self._next + 1) % len(self._slots)
        if self._copy:
            return self._bytes(place)
        return self._slots[place.slot].view(self._descriptor, place)

    def _bytes(self, place: InMemory) -> bytes:
        message = os.pread(self._descriptor, place.bytes, place.offset)
        if len(message) != place.bytes:
            raise ProtocolError(f"the shared memory has {len(message)} of {place.bytes} bytes at {place.offset}")
        return message


class _Slot:
    """A slot of the memory: its mapping, and its latest observation."""

    def __init__(self) -> None:
        self._mapped: NDArray[Any] | None = None
        self._offset = 0
        self._latest: weakref.ref[NDArray[Any]] | None = None

    def is_in_use(self) -> bool:
        return self._latest is not None and self._latest() is not None

    def view(self, descriptor: int, place: InMemory) -> memoryview:
        """The bytes of a message, without a copy."""
        mapped = self._mapped
        if mapped is None or self._offset != place.offset or len(mapped) < place.bytes:
            pages = mmap.mmap(descriptor, place.bytes, mmap.MAP_SHARED, mmap.PROT_READ, offset=place.offset)
            mapped = self._mapped = np.frombuffer(pages, np.uint8)
            self._offset = place.offset
        # All arrays of the observation refer to this one, so it lives as long as any of them.
        message = mapped[: place.bytes].view()
        self._latest = weakref.ref(message)
        return message.data


def _open(offer: SharedMemoryOffer) -> tuple[int, str]:
    """The descriptor of the memory, and the text at its beginning."""
    try:
        # A path of another machine or container may be another file on this one: it is not opened.
        found = os.readlink(offer.path)
        if found != offer.target:
            raise OSError(f"it is {found}, not {offer.target}")
        if not 0 < offer.proof_bytes <= PROOF_BYTES:
            raise OSError(f"its proof has {offer.proof_bytes} bytes")
        descriptor = os.open(offer.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return descriptor, os.pread(descriptor, offer.proof_bytes, 0).decode("ascii")
        except BaseException:
            os.close(descriptor)
            raise
    except (OSError, ValueError) as error:
        raise ConnectFailed(
            f"cannot open the server's memory {offer.path}: {error}. The server must run on this machine, in the same "
            "container and as the same user; connect without shared_memory otherwise"
        ) from error
