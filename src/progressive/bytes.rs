//! The alphabet of the codecs: variable-length integers and floats as differences.
//!
//! - *varint*: little endian in groups of seven bits, the high bit of a byte set when more follow
//!   (LEB128); at most ten bytes.
//! - *signed*: zigzag (0, −1, 1, −2, …) as a varint.
//! - *double*: a code byte and a payload. The bits of value and prediction are mapped to integers
//!   in the order of the numbers; their difference (modulo 2⁶⁴), zigzag, is the payload, the least
//!   significant byte first, without leading zero bytes. Codes 0 to 8 give its length. A value
//!   that single precision holds exactly may use codes 9 to 13: the same in 32 bits, with payloads
//!   of 0 to 4 bytes and the prediction rounded to single precision.
//! - *single*: the same in 32 bits alone, codes 0 to 4.

use super::error::Damage;

pub(super) fn put_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

pub(super) fn put_signed(out: &mut Vec<u8>, value: i64) {
    put_varint(out, zigzag(value));
}

/// `to - from` of two ids, as [`put_signed`] takes it.
pub(super) fn delta(from: u32, to: u32) -> i64 {
    i64::from(to) - i64::from(from)
}

/// Code byte of a double; the payload goes to `payload`.
pub(super) fn put_double(payload: &mut Vec<u8>, prediction: f64, value: f64) -> u8 {
    let difference = ordered64(value.to_bits()).wrapping_sub(ordered64(prediction.to_bits()));
    let long = zigzag(difference as i64);
    let single = value as f32;
    if f64::from(single).to_bits() == value.to_bits() {
        let short = zigzag32(prediction as f32, single);
        if n_bytes(short) < n_bytes(long) {
            return 9 + put_payload(payload, short);
        }
    }
    put_payload(payload, long)
}

/// Code byte of a single; the payload goes to `payload`.
pub(super) fn put_single(payload: &mut Vec<u8>, prediction: f32, value: f32) -> u8 {
    put_payload(payload, zigzag32(prediction, value))
}

fn put_payload(payload: &mut Vec<u8>, value: u64) -> u8 {
    let n = n_bytes(value);
    payload.extend(value.to_le_bytes().iter().take(n));
    n as u8
}

fn n_bytes(value: u64) -> usize {
    (64 - value.leading_zeros() as usize).div_ceil(8)
}

fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)) as u64
}

fn unzigzag(value: u64) -> i64 {
    (value >> 1) as i64 ^ -((value & 1) as i64)
}

fn zigzag32(prediction: f32, value: f32) -> u64 {
    let difference = ordered32(value.to_bits()).wrapping_sub(ordered32(prediction.to_bits()));
    let difference = difference as i32;
    u64::from(((difference << 1) ^ (difference >> 31)) as u32)
}

/// Float bits to integers in the order of the numbers.
fn ordered64(bits: u64) -> u64 {
    if bits >> 63 == 1 { !bits } else { bits ^ (1 << 63) }
}

fn unordered64(ordered: u64) -> u64 {
    if ordered >> 63 == 1 { ordered ^ (1 << 63) } else { !ordered }
}

fn ordered32(bits: u32) -> u32 {
    if bits >> 31 == 1 { !bits } else { bits ^ (1 << 31) }
}

fn unordered32(ordered: u32) -> u32 {
    if ordered >> 31 == 1 { ordered ^ (1 << 31) } else { !ordered }
}

/// Reads what the functions above put.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cursor<'a> {
    rest: &'a [u8],
}

const SHORT: Damage = Damage("the data end too early");

impl<'a> Cursor<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    pub(super) fn n_left(&self) -> usize {
        self.rest.len()
    }

    pub(super) fn take(&mut self, n: usize) -> Result<&'a [u8], Damage> {
        let (taken, rest) = self.rest.split_at_checked(n).ok_or(SHORT)?;
        self.rest = rest;
        Ok(taken)
    }

    pub(super) fn array<const N: usize>(&mut self) -> Result<[u8; N], Damage> {
        let (taken, rest) = self.rest.split_first_chunk().ok_or(SHORT)?;
        self.rest = rest;
        Ok(*taken)
    }

    pub(super) fn byte(&mut self) -> Result<u8, Damage> {
        self.array::<1>().map(|[b]| b)
    }

    pub(super) fn varint(&mut self) -> Result<u64, Damage> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            let bits = u64::from(byte & 0x7f);
            if shift == 63 && bits > 1 {
                break;
            }
            value |= bits << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(Damage("a number is longer than 64 bits"))
    }

    /// A varint that fits 32 bits.
    pub(super) fn id(&mut self) -> Result<u32, Damage> {
        self.varint()?.try_into().map_err(|_| Damage("an id is over 32 bits"))
    }

    /// A count of things that take at least one byte each of what is left.
    pub(super) fn count(&mut self) -> Result<usize, Damage> {
        let n = self.varint()?;
        if n > self.rest.len() as u64 {
            return Err(SHORT);
        }
        Ok(n as usize)
    }

    /// The id that differs from `from` by a signed number.
    pub(super) fn id_near(&mut self, from: u32) -> Result<u32, Damage> {
        let delta = unzigzag(self.varint()?);
        i64::from(from)
            .checked_add(delta)
            .and_then(|id| id.try_into().ok())
            .ok_or(Damage("an id is over 32 bits"))
    }

    /// The double of a code byte.
    pub(super) fn double(&mut self, code: u8, prediction: f64) -> Result<f64, Damage> {
        match code {
            0..=8 => {
                let difference = unzigzag(self.payload(code)?) as u64;
                let ordered = ordered64(prediction.to_bits()).wrapping_add(difference);
                Ok(f64::from_bits(unordered64(ordered)))
            }
            9..=13 => self.single(code - 9, prediction as f32).map(f64::from),
            _ => Err(Damage("unknown code of a number")),
        }
    }

    /// The single of a code byte.
    pub(super) fn single(&mut self, code: u8, prediction: f32) -> Result<f32, Damage> {
        if code > 4 {
            return Err(Damage("unknown code of a number"));
        }
        let zigzag = self.payload(code)? as u32;
        let difference = (zigzag >> 1) ^ (zigzag & 1).wrapping_neg();
        let ordered = ordered32(prediction.to_bits()).wrapping_add(difference);
        Ok(f32::from_bits(unordered32(ordered)))
    }

    fn payload(&mut self, n: u8) -> Result<u64, Damage> {
        let bytes = self.take(n.into())?;
        Ok(bytes.iter().rev().fold(0, |value, byte| value << 8 | u64::from(*byte)))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn integers_survive(value in any::<u64>(), shift in 0..64_u32) {
            let (value, mut out) = (value >> shift, Vec::new());
            put_varint(&mut out, value);
            prop_assert_eq!(Cursor::new(&out).varint(), Ok(value));
            prop_assert_eq!(unzigzag(zigzag(value as i64)), value as i64);
        }

        #[test]
        fn floats_survive_bit_by_bit(
            bits in any::<u64>(),
            guess in prop_oneof![any::<u64>(), Just(0)],
            is_single in any::<bool>(),
        ) {
            let value =
                if is_single { f32::from_bits(bits as u32).into() } else { f64::from_bits(bits) };
            let mut payload = Vec::new();
            let code = put_double(&mut payload, f64::from_bits(guess), value);
            let again = Cursor::new(&payload).double(code, f64::from_bits(guess)).unwrap();
            prop_assert_eq!(again.to_bits(), value.to_bits());
            let (value, guess) = (f32::from_bits(bits as u32), f32::from_bits(guess as u32));
            payload.clear();
            let code = put_single(&mut payload, guess, value);
            let again = Cursor::new(&payload).single(code, guess).unwrap();
            prop_assert_eq!(again.to_bits(), value.to_bits());
        }
    }

    #[test]
    fn near_values_are_short() {
        let mut payload = Vec::new();
        assert_eq!(put_double(&mut payload, 0.1, 0.1), 0);
        assert_eq!(put_double(&mut payload, 0.1_f32.into(), 0.100_000_01_f32.into()), 10);
        assert_eq!(payload.len(), 1);
        assert!(Cursor::new(&[0xff; 12]).varint().is_err());
    }
}
