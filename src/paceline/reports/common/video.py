"""Writes an H.264 video frame by frame, with the time stamps of the frames."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np

from paceline.errors import UnusableInput
from paceline.processor_cores import max_threads
from paceline.reports.common.drawing import Picture
from paceline.verdicts import message

TICKS_PER_S = 60000  # time stamps per second; MPEG-4 allows 65535
H264_CODECS = ["libx264", "libopenh264"]  # both write H.264, which browsers play
FALLBACK_CODEC = "mpeg4"
FALLBACK_BIT_RATE = 8_000_000  # bits per second, for encoders without constant quality


class VideoWriter:
    """Writes an MP4 file; all pictures have the first one's size, which is even in both directions.

    With ``fragmented`` the file's index does not grow in memory with its length, at the price of slower seeking.
    ``notices`` has a note where no H.264 encoder is available and the video is MPEG-4 instead.
    """

    def __init__(self, file: Path, step: float, crf: int = 20, fragmented: bool = False) -> None:
        """``step`` is the usual time between pictures, seconds; a higher ``crf`` means a smaller, coarser file."""
        self.notices: list[str] = []
        self._codec = next((name for name in H264_CODECS if name in av.codecs_available), FALLBACK_CODEC)
        if self._codec == FALLBACK_CODEC:
            self.notices.append(message("video_codec_fallback"))
        flags = "frag_keyframe+empty_moov+default_base_moof" if fragmented else "+faststart"
        self._container = av.open(str(file), "w", format="mp4", options={"movflags": flags})
        self._stream: av.VideoStream | None = None
        self._name, self._step, self._crf = file.name, step, crf
        self._start, self._last = 0.0, -1

    def add(self, picture: Picture, time: float) -> None:
        """Appends ``picture`` (H, W, 3), BGR, shown at ``time`` seconds."""
        if self._stream is None:
            self._stream = self._add_stream(picture)
            self._start = time
        image = av.VideoFrame.from_ndarray(picture, format="bgr24")
        self._last = max(round((time - self._start) * TICKS_PER_S), self._last + 1)
        image.pts, image.time_base, image.duration = (
            self._last,
            Fraction(1, TICKS_PER_S),
            round(self._step * TICKS_PER_S),
        )
        self._encode(self._stream, image)

    def _encode(self, stream: av.VideoStream, image: av.VideoFrame | None) -> None:
        """Writes what ``stream`` makes of a further ``image``, or of those that it has kept."""
        try:
            packets = stream.encode(image)
        except av.error.ExternalError as error:  # the encoder's own; of pictures that it takes, of want of memory
            raise UnusableInput(f"{self._name}: the encoder {self._codec} failed; expected more memory") from error
        self._container.mux(packets)

    def _add_stream(self, picture: Picture) -> av.VideoStream:
        options = {"preset": "veryfast", "crf": str(self._crf)} if self._codec == "libx264" else {}
        rate = Fraction(1 / self._step).limit_denominator(1000) or Fraction(1)
        stream = self._container.add_stream(self._codec, rate=rate, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, TICKS_PER_S)
        stream.codec_context.thread_count = max_threads()
        if self._codec != "libx264":
            stream.bit_rate = FALLBACK_BIT_RATE
        return stream

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None and self._stream is not None:
            self._encode(self._stream, None)
        self._container.close()


def pad_to_even(picture: Picture) -> Picture:
    """``picture`` (H, W, 3) with a black row or column added where it has an odd number: chroma is halved."""
    height, width = picture.shape[:2]
    if height % 2 or width % 2:
        return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)))
    return picture
