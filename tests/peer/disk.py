"""A block device that records every write and flush: a FUSE file in this process below a loop device of the kernel.

    disk.py IMAGE LOG MOUNTPOINT

serves MOUNTPOINT/disk, a file with the content of IMAGE, until it is unmounted. Each write is applied to IMAGE and appended
to LOG, each flush as well, in the order in which the kernel sends them. The loop device declares a volatile write cache, so
the kernel sends a flush wherever a file system relies on durability, also in place of FUA. power.py replays the log.

The protocol is that of include/uapi/linux/fuse.h. Linux only; mounting needs root.
"""

import ctypes
import errno
import os
import struct
import sys

IN = struct.Struct("<IIQQIIIHH")  # fuse_in_header
OUT = struct.Struct("<IiQ")  # fuse_out_header
ATTR = struct.Struct("<6Q10I")
RANGE = struct.Struct("<QQII")  # the start of fuse_read_in and fuse_write_in
RECORD = struct.Struct("<cQI")  # of the log: kind, offset, length; then the bytes
WRITE, FLUSH = b"w", b"f"
LARGEST = 1 << 20
ROOT, FILE = 1, 2
(LOOKUP, FORGET, GETATTR, SETATTR, OPEN, READ, WRITING, STATFS, RELEASE, FSYNC, FLUSHING, INIT, OPENDIR, RELEASEDIR, INTERRUPT,
 DESTROY, FORGETS) = 1, 2, 3, 4, 14, 15, 16, 17, 18, 20, 25, 26, 27, 29, 36, 38, 42  # fmt: skip
DIRECT_IO = 1
BIG_WRITES, MAX_PAGES = 1 << 5, 1 << 22


class Server:
    def __init__(self, image, log, mountpoint):
        self.image = os.open(image, os.O_RDWR)
        self.log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self.size = os.fstat(self.image).st_size
        self.fuse = os.open("/dev/fuse", os.O_RDWR)
        options = f"fd={self.fuse},rootmode=40000,user_id=0,group_id=0"
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mount(b"power", os.fsencode(mountpoint), b"fuse", 0, options.encode()) != 0:
            raise OSError(ctypes.get_errno(), f"mounting {mountpoint}")

    def attr(self, node):
        mode, size = (0o40755, 4096) if node == ROOT else (0o100600, self.size)
        return ATTR.pack(node, size, size // 512, 0, 0, 0, 0, 0, 0, mode, 1, 0, 0, 0, 4096, 0)

    def run(self):
        while True:
            try:
                request = os.read(self.fuse, LARGEST + 4096)
            except OSError as error:
                if error.errno == errno.ENODEV:  # unmounted
                    return
                if error.errno in (errno.EINTR, errno.ENOENT, errno.EAGAIN):
                    continue
                raise
            _, code, unique, node, *_ = IN.unpack_from(request)
            if code in (FORGET, FORGETS, INTERRUPT):
                continue
            answer = self.answer(code, node, memoryview(request)[IN.size :])
            failure, payload = (answer, b"") if isinstance(answer, int) else (0, answer)
            os.writev(self.fuse, [OUT.pack(OUT.size + len(payload), -failure, unique), payload])

    def answer(self, code, node, body):
        """The payload of the answer, or the number of an error."""
        if code == INIT:
            minor = min(struct.unpack_from("<II", body)[1], 38)
            return struct.pack(
                "<IIIIHHIIHHI28x", 7, minor, 0, BIG_WRITES | MAX_PAGES, 16, 12, LARGEST, 1, LARGEST // 4096, 0, 0
            )
        if code == LOOKUP:
            if bytes(body).rstrip(b"\0") != b"disk":
                return errno.ENOENT
            return struct.pack("<QQQQII", FILE, 0, 1 << 20, 1 << 20, 0, 0) + self.attr(FILE)
        if code in (GETATTR, SETATTR):
            return struct.pack("<QII", 1 << 20, 0, 0) + self.attr(node)
        if code in (OPEN, OPENDIR):
            return struct.pack("<QII", 1, DIRECT_IO if code == OPEN else 0, 0)
        if code == READ:
            _, offset, size, _ = RANGE.unpack_from(body)
            return os.pread(self.image, size, offset)
        if code == WRITING:
            _, offset, size, _ = RANGE.unpack_from(body)
            data = body[40 : 40 + size]
            os.pwrite(self.image, data, offset)
            os.writev(self.log, [RECORD.pack(WRITE, offset, size), data])
            return struct.pack("<II", size, 0)
        if code == FSYNC:
            os.write(self.log, RECORD.pack(FLUSH, 0, 0))
            return b""
        if code == STATFS:
            return bytes(80)
        return b"" if code in (FLUSHING, RELEASE, RELEASEDIR, DESTROY) else errno.ENOSYS


if __name__ == "__main__":
    server = Server(*sys.argv[1:])
    print("ready", flush=True)
    server.run()
