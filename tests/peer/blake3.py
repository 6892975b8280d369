"""BLAKE3 in plain Python, from section 2 of its specification, for verify.py. It hashes about a megabyte in a second."""

import struct

IV = (0x6A09E667, 0xBB67AE85, 0x3C6EF372, 0xA54FF53A, 0x510E527F, 0x9B05688C, 0x1F83D9AB, 0x5BE0CD19)
ORDER = (2, 6, 3, 10, 7, 0, 4, 13, 1, 11, 12, 5, 9, 14, 15, 8)
CHUNK_START, CHUNK_END, PARENT, ROOT = 1, 2, 4, 8
MASK = 0xFFFFFFFF
LANES = (
    (0, 4, 8, 12),
    (1, 5, 9, 13),
    (2, 6, 10, 14),
    (3, 7, 11, 15),
    (0, 5, 10, 15),
    (1, 6, 11, 12),
    (2, 7, 8, 13),
    (3, 4, 9, 14),
)


def compress(value, block, counter, length, flags):
    """The chaining value of a block of 64 bytes, of which `length` are input."""
    words = struct.unpack("<16I", block.ljust(64, b"\0"))
    v = [*value, *IV[:4], counter & MASK, counter >> 32, length, flags]
    for _ in range(7):
        for i, (a, b, c, d) in enumerate(LANES):
            for word, (x, y) in zip(words[2 * i : 2 * i + 2], ((16, 12), (8, 7))):
                v[a] = (v[a] + v[b] + word) & MASK
                v[d] = (turned := v[d] ^ v[a]) >> x | turned << 32 - x & MASK
                v[c] = (v[c] + v[d]) & MASK
                v[b] = (turned := v[b] ^ v[c]) >> y | turned << 32 - y & MASK
        words = [words[i] for i in ORDER]
    return [v[i] ^ v[i + 8] for i in range(8)]


def chunk(data, counter, root):
    """The chaining value of up to 1024 bytes."""
    value = IV
    for at in range(0, max(len(data), 1), 64):
        block, is_last = data[at : at + 64], at + 64 >= len(data)
        flags = CHUNK_START * (at == 0) | CHUNK_END * is_last | ROOT * (is_last and root)
        value = compress(value, block, counter, len(block), flags)
    return value


def tree(data, counter, root):
    """The chaining value of a subtree whose first chunk has the number `counter`."""
    if len(data) <= 1024:
        return chunk(data, counter, root)
    # The left subtree is the largest complete one that leaves at least a byte to the right one.
    left = 1024 << ((len(data) - 1) // 1024).bit_length() - 1
    children = tree(data[:left], counter, False) + tree(data[left:], counter + left // 1024, False)
    return compress(IV, struct.pack("<16I", *children), 0, 64, PARENT | ROOT * root)


def blake3(data):
    """The digest of some bytes: 32 bytes."""
    return struct.pack("<8I", *tree(data, 0, True))
