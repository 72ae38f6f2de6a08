//! How answers are written: numbers as LEB128, signed ones zigzag, floats as they are.

use glam::DVec3;

/// What can be an answer. `read` takes from the front, `None` where that is not what `write` wrote.
pub trait Answer: Sized {
    /// Appends it.
    fn write(&self, out: &mut Vec<u8>);
    /// Takes it from the front.
    fn read(bytes: &mut &[u8]) -> Option<Self>;
}

impl Answer for u8 {
    fn write(&self, out: &mut Vec<u8>) {
        out.push(*self);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let (first, rest) = bytes.split_first()?;
        *bytes = rest;
        Some(*first)
    }
}

impl Answer for u64 {
    fn write(&self, out: &mut Vec<u8>) {
        let mut left = *self;
        while left >= 0x80 {
            out.push(left as u8 | 0x80);
            left >>= 7;
        }
        out.push(left as u8);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = u8::read(bytes)?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }
}

impl Answer for u32 {
    fn write(&self, out: &mut Vec<u8>) {
        u64::from(*self).write(out);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        u64::read(bytes)?.try_into().ok()
    }
}

impl Answer for i64 {
    fn write(&self, out: &mut Vec<u8>) {
        ((self << 1 ^ self >> 63) as u64).write(out);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let zigzag = u64::read(bytes)?;
        Some((zigzag >> 1) as i64 ^ -((zigzag & 1) as i64))
    }
}

impl Answer for f64 {
    fn write(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.to_bits().to_le_bytes());
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let (first, rest) = bytes.split_first_chunk()?;
        *bytes = rest;
        Some(Self::from_bits(u64::from_le_bytes(*first)))
    }
}

impl Answer for f32 {
    fn write(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.to_bits().to_le_bytes());
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let (first, rest) = bytes.split_first_chunk()?;
        *bytes = rest;
        Some(Self::from_bits(u32::from_le_bytes(*first)))
    }
}

impl Answer for DVec3 {
    fn write(&self, out: &mut Vec<u8>) {
        self.to_array().write(out);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        <[f64; 3]>::read(bytes).map(Self::from_array)
    }
}

impl<A: Answer + Copy + Default, const N: usize> Answer for [A; N] {
    fn write(&self, out: &mut Vec<u8>) {
        self.iter().for_each(|one| one.write(out));
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let mut all = [A::default(); N];
        for one in &mut all {
            *one = A::read(bytes)?;
        }
        Some(all)
    }
}

impl<A: Answer, B: Answer> Answer for (A, B) {
    fn write(&self, out: &mut Vec<u8>) {
        self.0.write(out);
        self.1.write(out);
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        Some((A::read(bytes)?, B::read(bytes)?))
    }
}

impl<A: Answer> Answer for Option<A> {
    fn write(&self, out: &mut Vec<u8>) {
        out.push(u8::from(self.is_some()));
        self.iter().for_each(|one| one.write(out));
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        match u8::read(bytes)? {
            0 => Some(None),
            1 => A::read(bytes).map(Some),
            _ => None,
        }
    }
}

impl<T: Answer> Answer for Vec<T> {
    fn write(&self, out: &mut Vec<u8>) {
        (self.len() as u64).write(out);
        self.iter().for_each(|one| one.write(out));
    }

    fn read(bytes: &mut &[u8]) -> Option<Self> {
        let n = u64::read(bytes)?;
        // Each takes a byte at least: what is announced beyond that is not there.
        let mut all = Self::with_capacity(n.min(bytes.len() as u64) as usize);
        for _ in 0..n {
            all.push(T::read(bytes)?);
        }
        Some(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<A: Answer + PartialEq + std::fmt::Debug>(answer: &A) {
        let mut bytes = Vec::new();
        answer.write(&mut bytes);
        let mut rest = bytes.as_slice();
        assert_eq!(A::read(&mut rest).as_ref(), Some(answer));
        assert!(rest.is_empty());
        for n in 0..bytes.len() {
            assert_eq!(A::read(&mut &bytes[..n]), None, "{answer:?} broken off at {n}");
        }
    }

    #[test]
    fn answers_survive_a_round_trip() {
        [0, 1, 127, 128, 1 << 40, u64::MAX].iter().for_each(check);
        [0, -1, 1, 63, 64, -64, -65, i64::MIN, i64::MAX].iter().for_each(check);
        [0.0, -0.0, 1.5, f64::INFINITY, f64::MIN_POSITIVE].iter().for_each(check);
        check(&vec![-5_i64, 0, 1 << 33]);
        check(&Some(7_u64));
        check(&None::<u64>);
        check(&(vec![(7_u32, DVec3::new(1.0, -2.0, 3.5))], vec![(1_u32, [0.5_f32, 1.0, -1.0])]));
    }

    #[test]
    fn nonsense_is_refused_without_much_memory() {
        let mut lies = Vec::new();
        u64::MAX.write(&mut lies);
        assert_eq!(Vec::<i64>::read(&mut lies.as_slice()), None);
        assert_eq!(u64::read(&mut [0xff; 11].as_slice()), None);
        assert_eq!(u32::read(&mut lies.as_slice()), None);
    }
}
