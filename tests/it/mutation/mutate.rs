//! Random changes of bytes, like those by disks, editors and attackers.

use crate::support::Draw;

/// Text to insert: brackets, literals, encodings, numbers at the limits of a type.
const PIECES: &[&[u8]] = &[
    b"{",
    b"}",
    b"[",
    b"]",
    b"\"",
    b"\\",
    b",",
    b":",
    b"'",
    b"//",
    b"/*",
    b"\0",
    b"\n",
    b"\xff",
    b"\xef\xbb\xbf",
    b"\\ud800",
    b"\\u0000",
    b"\\u001b[31m",
    b"\xe2\x80\xae",
    b"NaN",
    b"-Infinity",
    b"1e999",
    b"-",
    b"0",
    b"-1",
    b"1.5",
    b"null",
    b"true",
    b"{}",
    b"[]",
    b"\"\"",
    b"../",
    b"/",
    b"18446744073709551615",
    b"18446744073709551616",
    b"9223372036854775808",
    b"4294967296",
    b"2305843009213693951",
    b"=======\n",
    b"<<<<<<< HEAD\n",
    b"__metadata__",
    b"data_offsets",
    b"\"dtype\":\"F4\"",
    b"class ",
    b"import ",
    b"from . import x\n",
    b"    ",
    b"\t",
    b"(",
    b")",
    b"\"\"\"",
    b"f'{",
];

/// Changes bytes, by choices that follow from a seed.
pub struct Mutator(pub Draw);

impl Mutator {
    /// Returns `bytes` after one to four changes; `other` is another file whose parts may be inserted.
    pub fn mutate(&mut self, bytes: &[u8], other: &[u8]) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        for _ in 0..=self.0.below(4) {
            self.change(&mut bytes, other);
        }
        // Without this, half of the changed headers would fail because of their length.
        if self.0.below(2) == 0 {
            mend_length(&mut bytes);
        }
        bytes
    }

    fn change(&mut self, bytes: &mut Vec<u8>, other: &[u8]) {
        // Headers and important keys are at the start of a file.
        let reach = if self.0.below(2) == 0 { bytes.len().min(600) } else { bytes.len() };
        let at = self.0.below(reach + 1).min(bytes.len());
        let end = (at + self.0.below(12)).min(bytes.len());
        match self.0.below(10) {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(at..end)),
            2 => bytes.splice(at..at, bytes[at..end].to_vec()).for_each(drop),
            3 | 4 => {
                let piece = PIECES[self.0.below(PIECES.len())];
                bytes.splice(at..end, piece.iter().copied()).for_each(drop);
            }
            5 => {
                let piece = PIECES[self.0.below(PIECES.len())];
                let times = 1 << self.0.below(9);
                bytes.splice(at..at, piece.repeat(times)).for_each(drop);
            }
            6 => self.number(bytes, at),
            7 => {
                let from = self.0.below(other.len());
                let part = &other[from..(from + self.0.below(400)).min(other.len())];
                bytes.splice(at..end, part.iter().copied()).for_each(drop);
            }
            _ => {
                for _ in 0..=self.0.below(3) {
                    let at = self.0.below(reach);
                    let flip = 1 << self.0.below(8);
                    if let Some(byte) = bytes.get_mut(at) {
                        *byte ^= flip;
                    }
                }
            }
        }
    }

    /// Changes the next number in the text.
    fn number(&mut self, bytes: &mut Vec<u8>, at: usize) {
        let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit).map(|n| at + n) else { return };
        let len = bytes[start..].iter().take_while(|b| b.is_ascii_digit()).count();
        let old: u64 = std::str::from_utf8(&bytes[start..start + len]).unwrap().parse().unwrap_or(0);
        let new = match self.0.below(6) {
            0 => old.wrapping_add(1),
            1 => old.wrapping_sub(1),
            2 => old.wrapping_mul(2),
            3 => 0,
            4 => u64::MAX - old % 16,
            _ => 1_u64 << self.0.below(64),
        };
        bytes.splice(start..start + len, new.to_string().into_bytes()).for_each(drop);
    }
}

/// Sets the length field of a shard to the end of its header, if the header has an end.
fn mend_length(bytes: &mut [u8]) {
    if bytes.get(8) != Some(&b'{') {
        return;
    }
    // The header of every seed ends with these brackets, followed by spaces.
    let Some(end) = bytes.windows(3).rposition(|w| w == b"]}}").map(|n| n + 3) else { return };
    let spaces = bytes[end..].iter().take_while(|b| **b == b' ').count();
    let length = (end + spaces - 8) as u64;
    bytes[..8].copy_from_slice(&length.to_le_bytes());
}
