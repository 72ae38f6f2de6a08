//! Puts values into the streams of a section, or fills them from there, by the same calls: code
//! that walks over data with a [`Coder`] is encoder and decoder in one.

use super::{
    bytes::{delta, put_double, put_signed, put_single, put_varint},
    error::Damage,
    section::{Cursors, Streams},
};

/// Puts values into a stream, or fills them from it.
pub(super) trait Coder {
    fn byte(&mut self, value: &mut u8) -> Result<(), Damage>;
    /// A small number, in `shape`.
    fn small(&mut self, value: &mut u64) -> Result<(), Damage>;
    /// An id by itself.
    fn id(&mut self, value: &mut u32) -> Result<(), Damage>;
    /// An id as a difference.
    fn near(&mut self, from: u32, value: &mut u32) -> Result<(), Damage>;
    fn double(&mut self, prediction: f64, value: &mut f64) -> Result<(), Damage>;
    fn single(&mut self, prediction: f32, value: &mut f32) -> Result<(), Damage>;
}

impl Coder for Streams {
    fn byte(&mut self, value: &mut u8) -> Result<(), Damage> {
        self.shape.push(*value);
        Ok(())
    }
    fn small(&mut self, value: &mut u64) -> Result<(), Damage> {
        put_varint(&mut self.shape, *value);
        Ok(())
    }
    fn id(&mut self, value: &mut u32) -> Result<(), Damage> {
        put_varint(&mut self.ids, u64::from(*value));
        Ok(())
    }
    fn near(&mut self, from: u32, value: &mut u32) -> Result<(), Damage> {
        put_signed(&mut self.ids, delta(from, *value));
        Ok(())
    }
    fn double(&mut self, prediction: f64, value: &mut f64) -> Result<(), Damage> {
        let code = put_double(&mut self.digits, prediction, *value);
        self.shape.push(code);
        Ok(())
    }
    fn single(&mut self, prediction: f32, value: &mut f32) -> Result<(), Damage> {
        let code = put_single(&mut self.digits, prediction, *value);
        self.shape.push(code);
        Ok(())
    }
}

impl Coder for Cursors<'_> {
    fn byte(&mut self, value: &mut u8) -> Result<(), Damage> {
        *value = self.shape.byte()?;
        Ok(())
    }
    fn small(&mut self, value: &mut u64) -> Result<(), Damage> {
        *value = self.shape.varint()?;
        Ok(())
    }
    fn id(&mut self, value: &mut u32) -> Result<(), Damage> {
        *value = self.ids.id()?;
        Ok(())
    }
    fn near(&mut self, from: u32, value: &mut u32) -> Result<(), Damage> {
        *value = self.ids.id_near(from)?;
        Ok(())
    }
    fn double(&mut self, prediction: f64, value: &mut f64) -> Result<(), Damage> {
        let code = self.shape.byte()?;
        *value = self.digits.double(code, prediction)?;
        Ok(())
    }
    fn single(&mut self, prediction: f32, value: &mut f32) -> Result<(), Damage> {
        let code = self.shape.byte()?;
        *value = self.digits.single(code, prediction)?;
        Ok(())
    }
}
