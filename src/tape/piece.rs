//! Pieces of tape as they are stored: a magic number, a version and the size of the answers, then a zstd frame
//! of the answers.

const MAGIC: [u8; 4] = *b"LKTP";
/// Raised with every change of what is asked, in which order, or how it is written.
const VERSION: u8 = 2;
const HEADER: usize = 9;
/// Answers are numbers without much order.
const ZSTD_LEVEL: i32 = 1;

/// Most bytes of answers in a piece.
pub const MAX_PIECE: usize = 256 << 20;

/// Answers as a piece; `None` where they are more than one may hold.
pub fn pack(answers: &[u8]) -> Option<Vec<u8>> {
    let size = u32::try_from(answers.len()).ok().filter(|n| *n as usize <= MAX_PIECE)?;
    let packed = zstd::bulk::compress(answers, ZSTD_LEVEL).ok()?;
    Some([&MAGIC[..], &[VERSION], &size.to_le_bytes(), &packed].concat())
}

/// The answers of a piece.
pub(super) fn unpack(piece: &[u8]) -> Result<Vec<u8>, String> {
    let (header, packed) = piece.split_at_checked(HEADER).ok_or("a piece is broken off")?;
    let (magic, rest) = header.split_at(MAGIC.len());
    if magic != MAGIC || rest[0] != VERSION {
        return Err(format!("a piece is not of version {VERSION}"));
    }
    let size = u32::from_le_bytes([rest[1], rest[2], rest[3], rest[4]]) as usize;
    if size > MAX_PIECE {
        return Err("a piece is too large".into());
    }
    let answers = zstd::bulk::decompress(packed, size);
    let answers = answers.map_err(|e| format!("a piece is damaged: {e}"))?;
    if answers.len() == size { Ok(answers) } else { Err("a piece is too short".into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_survive_a_round_trip_and_damage_is_noticed() {
        let answers: Vec<u8> = (0..1000_u32).map(|k| ((k * k) >> 3) as u8).collect();
        let piece = pack(&answers).unwrap();
        assert_eq!(unpack(&piece), Ok(answers));
        for n in 0..piece.len() {
            assert!(unpack(&piece[..n]).is_err(), "broken off at {n}");
        }
        let mut other = piece.clone();
        other[4] += 1;
        assert!(unpack(&other).unwrap_err().contains("version"));
        let mut bomb = piece;
        bomb[5..9].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(unpack(&bomb).unwrap_err().contains("too large"));
    }
}
