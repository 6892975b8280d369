//! The pieces of a sentencepiece model: a bounded walk over its protocol buffer.

/// Maximum number of pieces, above that of any published vocabulary.
const MAX_PIECES: usize = 1_500_000;

/// Piece strings in id order. Source: `ModelProto` (field 1, repeated `SentencePiece`) and
/// `SentencePiece` (field 1, the string) in `sentencepiece_model.proto`.
pub(super) fn pieces(bytes: &[u8]) -> Result<Vec<&str>, &'static str> {
    let mut pieces = Vec::new();
    let mut rest = bytes;
    while !rest.is_empty() {
        let (number, value) = field(&mut rest)?;
        if number != 1 {
            continue;
        }
        if pieces.len() >= MAX_PIECES {
            return Err("it has more than a million and a half pieces");
        }
        let mut message = value.ok_or("its first field is not a message")?;
        let mut piece = "";
        while !message.is_empty() {
            if let (1, Some(bytes)) = field(&mut message)? {
                piece = std::str::from_utf8(bytes).map_err(|_| "a piece is not UTF-8")?;
            }
        }
        pieces.push(piece);
    }
    if pieces.is_empty() { Err("it has no pieces") } else { Ok(pieces) }
}

/// One field: its number, and its bytes if it is length-delimited.
fn field<'a>(rest: &mut &'a [u8]) -> Result<(u64, Option<&'a [u8]>), &'static str> {
    let tag = varint(rest)?;
    let value = match tag & 7 {
        0 => {
            varint(rest)?;
            None
        }
        1 => {
            take(rest, 8)?;
            None
        }
        2 => {
            let len = varint(rest)?;
            Some(take(rest, len)?)
        }
        5 => {
            take(rest, 4)?;
            None
        }
        _ => return Err("it is not a protocol buffer"),
    };
    Ok((tag >> 3, value))
}

fn take<'a>(rest: &mut &'a [u8], len: u64) -> Result<&'a [u8], &'static str> {
    let split = usize::try_from(len).ok().and_then(|len| rest.split_at_checked(len));
    let (taken, left) = split.ok_or("it ends in the middle of a field")?;
    *rest = left;
    Ok(taken)
}

fn varint(rest: &mut &[u8]) -> Result<u64, &'static str> {
    let mut value = 0_u64;
    for shift in (0..64).step_by(7) {
        let (byte, left) = rest.split_first().ok_or("it ends in the middle of a number")?;
        *rest = left;
        // Bits beyond the 64th are dropped, as in protobuf's own readers.
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Ok(value);
        }
    }
    Err("it has a number that never ends")
}
