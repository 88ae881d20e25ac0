"""Frames, arrays and metadata to and from files."""

from equipix.io.images import description, frame_format, read_frames, stream_frames
from equipix.io.masks import read_mask
from equipix.io.names import as_path, find_files, refuse_inputs
from equipix.io.pages import (
    SUFFIXES,
    check_format,
    check_pages,
    load_pages,
    refuse_saved,
    save_pages,
    saved_kind,
)
from equipix.io.png import write_png
from equipix.io.tiff import write_frames
from equipix.io.whole import folder_beside, replace_folder, write_whole

__all__ = [
    "SUFFIXES",
    "as_path",
    "check_format",
    "check_pages",
    "description",
    "find_files",
    "folder_beside",
    "frame_format",
    "load_pages",
    "read_frames",
    "read_mask",
    "refuse_inputs",
    "refuse_saved",
    "replace_folder",
    "save_pages",
    "saved_kind",
    "stream_frames",
    "write_frames",
    "write_png",
    "write_whole",
]
