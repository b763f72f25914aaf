"""Zip files that depend on their contents alone."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping


def pack(members: Mapping[str, bytes]) -> bytes:
    """A zip file of sorted members with a fixed date.

    Args:
        members: contents by path.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(members):
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3  # Unix, wherever it is packed
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, members[name])
    return stream.getvalue()
