//! Bytes in, bytes out: variable-length integers and bit-exact floats.
//!
//! Decoding is total: any input gives a value or a [`CodecError`], and nothing is allocated for a
//! count that the remaining bytes cannot hold.

use glam::DVec3;

/// Why bytes are not a progressive mesh.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// The input ends early.
    #[error("{what} is cut short at byte {at}; fetch the file again")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Offset in the block.
        at: usize,
    },
    /// A value is impossible.
    #[error("{what}: {problem}; the file is damaged or not a progressive mesh, fetch it again")]
    Malformed {
        /// What was being read.
        what: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// A checksum does not match.
    #[error("{what}: checksum mismatch; the file is damaged, fetch it again")]
    Checksum {
        /// Which part.
        what: &'static str,
    },
    /// Written by a later version.
    #[error("file format version {found}; this build reads version {known}: use a newer build")]
    Version {
        /// Of the file.
        found: u32,
        /// Of this build.
        known: u32,
    },
}

/// Appends an unsigned integer, seven bits a byte, low bits first (LEB128).
pub fn put_uint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Appends three 64-bit floats, little endian, bit by bit.
pub fn put_vec3(out: &mut Vec<u8>, v: DVec3) {
    for c in v.to_array() {
        out.extend_from_slice(&c.to_bits().to_le_bytes());
    }
}

/// Reads what the `put` functions wrote.
#[derive(Clone, Debug)]
pub struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    what: &'static str,
}

impl<'a> Cursor<'a> {
    /// A cursor at the start; `what` names the input in errors.
    pub fn new(bytes: &'a [u8], what: &'static str) -> Self {
        Self { bytes, at: 0, what }
    }

    /// Whether everything was read.
    pub fn is_at_end(&self) -> bool {
        self.at == self.bytes.len()
    }

    /// The next `n` bytes.
    pub fn take(&mut self, n: usize) -> Result<&'a [u8], CodecError> {
        let end = self.at.checked_add(n).filter(|e| *e <= self.bytes.len());
        let Some(end) = end else {
            return Err(CodecError::Truncated { what: self.what, at: self.bytes.len() });
        };
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }

    /// A fixed number of bytes.
    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], CodecError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    /// An unsigned integer.
    pub fn uint(&mut self) -> Result<u64, CodecError> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let [byte] = self.array::<1>()?;
            value |= u64::from(byte & 0x7f).checked_shl(shift).unwrap_or(0);
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(self.malformed("an integer of more than 64 bits"))
    }

    /// An unsigned integer below 2^32.
    pub fn id(&mut self) -> Result<u32, CodecError> {
        let value = self.uint()?;
        u32::try_from(value).map_err(|_| self.malformed(format!("id {value} is above 2^32")))
    }

    /// A count of things that take at least `bytes_each` bytes.
    pub fn count(&mut self, bytes_each: usize) -> Result<usize, CodecError> {
        let count = self.uint()?;
        let room = (self.bytes.len() - self.at) / bytes_each.max(1);
        usize::try_from(count).ok().filter(|c| *c <= room).ok_or(CodecError::Truncated {
            what: self.what,
            at: self.at,
        })
    }

    /// Three 64-bit floats.
    pub fn vec3(&mut self) -> Result<DVec3, CodecError> {
        let mut c = [0.0; 3];
        for v in &mut c {
            *v = f64::from_bits(u64::from_le_bytes(self.array()?));
        }
        Ok(DVec3::from_array(c))
    }

    /// A 32-bit float.
    pub fn f32(&mut self) -> Result<f32, CodecError> {
        Ok(f32::from_bits(u32::from_le_bytes(self.array()?)))
    }

    /// An error about the value just read.
    pub fn malformed(&self, problem: impl Into<String>) -> CodecError {
        CodecError::Malformed { what: self.what, problem: problem.into() }
    }
}
