"""HDF5 files of strangers: whether what they seem to hold lies in them.

HDF5 can refer to other files, by links and as storage of its arrays. Whoever reads or copies such
an array reads a file that somebody else has chosen.
"""

import h5py
from h5py import h5d, h5l

_LINK = "{} is a link; expected the data themselves"
_ELSEWHERE = "{} lies in another file; expected it in this one"


def link(group: h5py.Group, name: str) -> str | None:
    """Says that a name in a group is a link to somewhere else; None if it is not, or is absent."""
    links, place = group.id.links, name.encode()
    if not links.exists(place) or links.get_info(place).type == h5l.TYPE_HARD:
        return None
    return _LINK.format(_joined(group, name))


def way_out(group: h5py.Group) -> str | None:
    """Says what below a group is a link or lies in another file; None if all of it is here.

    Raises:
      OSError, RuntimeError, KeyError: the group is damaged.
    """

    def look_at_link(name: bytes, info: h5l.LinkInfo) -> str | None:
        if info.type == h5l.TYPE_HARD:
            return None
        return _LINK.format(_joined(group, name.decode(errors="replace")))

    def look_at_array(name: str, item: h5py.Group | h5py.Dataset) -> str | None:
        if not isinstance(item, h5py.Dataset):
            return None
        made = item.id.get_create_plist()
        if made.get_layout() != h5d.VIRTUAL and not made.get_external_count():
            return None
        return _ELSEWHERE.format(_joined(group, name))

    # A visit ends with the first answer. Links come first: they are looked at, not followed.
    found: str | None = group.id.links.visit(look_at_link, info=True)
    return found or group.visititems(look_at_array)


def _joined(group: h5py.Group, name: str) -> str:
    return f"{group.name}/{name}".strip("/")
