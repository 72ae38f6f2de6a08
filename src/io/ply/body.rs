//! The values of a PLY file one after the other, whatever the encoding. Every integer type and
//! single-precision value is exact in f64.

use super::header::{Kind, Scalar};

/// A stream of values.
pub(super) trait Values {
    /// The least bytes that a property takes.
    fn min_bytes(kind: Kind) -> u64;
    /// The next value; `None` at the end or where there is no number.
    fn next(&mut self, kind: Scalar) -> Option<f64>;
    /// Bytes not read yet.
    fn n_left(&self) -> u64;
    /// Line of the value last read, where there are lines.
    fn line(&self) -> Option<usize>;
}

/// Words between white space; line ends count only for messages.
pub(super) struct AsciiValues<'a> {
    rest: &'a [u8],
    line: usize,
}

impl<'a> AsciiValues<'a> {
    /// `n_lines` precede `rest` in the file.
    pub(super) fn new(rest: &'a [u8], n_lines: usize) -> Self {
        Self { rest, line: n_lines + 1 }
    }
}

impl Values for AsciiValues<'_> {
    fn min_bytes(_: Kind) -> u64 {
        // A digit and a separator.
        2
    }

    fn next(&mut self, kind: Scalar) -> Option<f64> {
        let blank = self.rest.iter().take_while(|b| b.is_ascii_whitespace()).count();
        self.line += self.rest[..blank].split(|b| *b == b'\n').count() - 1;
        self.rest = &self.rest[blank..];
        let length = self.rest.iter().take_while(|b| !b.is_ascii_whitespace()).count();
        let (word, rest) = self.rest.split_at(length);
        let word = str::from_utf8(word).ok()?;
        let value = match kind {
            Scalar::F32 => f64::from(word.parse::<f32>().ok()?),
            _ => word.parse().ok()?,
        };
        self.rest = rest;
        Some(value)
    }

    fn n_left(&self) -> u64 {
        self.rest.len() as u64
    }

    fn line(&self) -> Option<usize> {
        Some(self.line)
    }
}

/// Fixed-size values, the most significant byte first if `BIG`.
pub(super) struct BinaryValues<'a, const BIG: bool> {
    rest: &'a [u8],
}

impl<'a, const BIG: bool> BinaryValues<'a, BIG> {
    pub(super) fn new(rest: &'a [u8]) -> Self {
        Self { rest }
    }

    /// The next `N` bytes, least significant first.
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.rest.split_first_chunk::<N>()?;
        self.rest = rest;
        let mut bytes = *first;
        if BIG {
            bytes.reverse();
        }
        Some(bytes)
    }
}

impl<const BIG: bool> Values for BinaryValues<'_, BIG> {
    fn min_bytes(kind: Kind) -> u64 {
        match kind {
            Kind::Scalar(scalar) | Kind::List { count: scalar, .. } => scalar.n_bytes(),
        }
    }

    fn next(&mut self, kind: Scalar) -> Option<f64> {
        Some(match kind {
            Scalar::I8 => i8::from_le_bytes(self.take()?).into(),
            Scalar::U8 => u8::from_le_bytes(self.take()?).into(),
            Scalar::I16 => i16::from_le_bytes(self.take()?).into(),
            Scalar::U16 => u16::from_le_bytes(self.take()?).into(),
            Scalar::I32 => i32::from_le_bytes(self.take()?).into(),
            Scalar::U32 => u32::from_le_bytes(self.take()?).into(),
            Scalar::F32 => f32::from_le_bytes(self.take()?).into(),
            Scalar::F64 => f64::from_le_bytes(self.take()?),
        })
    }

    fn n_left(&self) -> u64 {
        self.rest.len() as u64
    }

    fn line(&self) -> Option<usize> {
        None
    }
}
