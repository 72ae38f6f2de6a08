//! Accessors: typed, strided, sparse, normalized values out of buffer views.
//!
//! Invariant: ranges are computed with saturating 64-bit arithmetic and looked up with a check,
//! so no accessor can reach outside its view, and callers hold counts against the limits before
//! they ask for values. An accessor that names no bytes is all zeros (glTF 2.0 §5.1.1); these
//! have a limit together.

use gltf::json::{
    accessor::{Accessor, ComponentType, Type},
    validation::Checked,
};

use super::{Document, IoError, REMEDY};

/// An accessor whose indices and types have been looked up.
pub(super) struct View<'a> {
    pub(super) accessor: &'a Accessor,
    pub(super) count: u64,
    pub(super) width: usize,
    pub(super) component: ComponentType,
}

impl<'a> Document<'a> {
    /// Looks up an accessor of one of the `allowed` types.
    pub(super) fn accessor(
        &self,
        index: usize,
        allowed: &[Type],
        place: &str,
    ) -> Result<View<'_>, IoError> {
        let Some(accessor) = self.root.accessors.get(index) else {
            let n = self.root.accessors.len() as u64;
            return Err(self.source.out_of_range(place, "accessors", index as i64, n));
        };
        let bad = |problem: &str| self.source.malformed(place, problem, REMEDY);
        let (Checked::Valid(kind), Checked::Valid(component)) =
            (accessor.type_, accessor.component_type)
        else {
            return Err(bad("unknown accessor type"));
        };
        if !allowed.contains(&kind) {
            return Err(bad(&format!("an accessor of type {kind:?} instead of {allowed:?}")));
        }
        let width = kind.multiplicity();
        Ok(View { accessor, count: accessor.count.0, width, component: component.0 })
    }

    /// All values as floats; integers are normalized if the accessor says so or `normalize` does.
    pub(super) fn floats(
        &self,
        view: &View<'_>,
        normalize: bool,
        place: &str,
    ) -> Result<Vec<f32>, IoError> {
        let convert = converter(view.component, normalize || view.accessor.normalized);
        self.values(view, convert, place)
    }

    /// All values of a scalar accessor of unsigned integers.
    pub(super) fn indices(&self, view: &View<'_>, place: &str) -> Result<Vec<u32>, IoError> {
        let convert = integer_converter(view.component)
            .ok_or_else(|| self.source.malformed(place, "indices are not unsigned", REMEDY))?;
        self.values(view, convert, place)
    }

    fn values<T: Copy + Default>(
        &self,
        view: &View<'_>,
        convert: fn(&[u8]) -> T,
        place: &str,
    ) -> Result<Vec<T>, IoError> {
        let n_bytes = view.component.size();
        let mut values = match view.accessor.buffer_view {
            Some(buffer_view) => {
                let at = Range {
                    view: buffer_view.value(),
                    offset: view.accessor.byte_offset.map_or(0, |o| o.0),
                    count: view.count,
                    n_bytes: n_bytes * view.width,
                };
                self.elements(&at, place)?
                    .flat_map(|e| e.chunks_exact(n_bytes).take(view.width).map(convert))
                    .collect()
            }
            None => self.zeros(view, place)?,
        };
        self.apply_sparse(view, convert, &mut values, place)?;
        Ok(values)
    }

    /// What an accessor has that names no bytes. Files may ask for many of them without being large.
    fn zeros<T: Copy + Default>(&self, view: &View<'_>, place: &str) -> Result<Vec<T>, IoError> {
        let n_values = view.count.saturating_mul(view.width as u64);
        let n_bytes = n_values.saturating_mul(size_of::<T>() as u64);
        let sum = self.n_zero_bytes.get().saturating_add(n_bytes);
        self.source.check_limit(place, "bytes of zeros", sum, self.source.limits.max_bytes)?;
        self.n_zero_bytes.set(sum);
        Ok(vec![T::default(); n_values as usize])
    }

    fn apply_sparse<T: Copy>(
        &self,
        view: &View<'_>,
        convert: fn(&[u8]) -> T,
        values: &mut [T],
        place: &str,
    ) -> Result<(), IoError> {
        let Some(sparse) = &view.accessor.sparse else { return Ok(()) };
        let place = format!("{place}: sparse values");
        let Checked::Valid(kind) = sparse.indices.component_type else {
            return Err(self.source.malformed(place, "unknown index type", REMEDY));
        };
        let (count, n_bytes) = (sparse.count.0, view.component.size());
        let at = Range {
            view: sparse.indices.buffer_view.value(),
            offset: sparse.indices.byte_offset.0,
            count,
            n_bytes: kind.0.size(),
        };
        let indices = self.elements(&at, &place)?;
        let at = Range {
            view: sparse.values.buffer_view.value(),
            offset: sparse.values.byte_offset.0,
            count,
            n_bytes: n_bytes * view.width,
        };
        let Some(read_index) = integer_converter(kind.0) else {
            return Err(self.source.malformed(place, "indices are not unsigned", REMEDY));
        };
        for (index, element) in indices.zip(self.elements(&at, &place)?) {
            let index = read_index(index);
            let Some(slot) = values.chunks_exact_mut(view.width).nth(index as usize) else {
                return Err(self.source.out_of_range(place, "elements", index.into(), view.count));
            };
            for (value, bytes) in slot.iter_mut().zip(element.chunks_exact(n_bytes)) {
                *value = convert(bytes);
            }
        }
        Ok(())
    }

    /// The bytes of each element of a strided range.
    fn elements(
        &self,
        range: &Range,
        place: &str,
    ) -> Result<impl Iterator<Item = &[u8]> + use<'_, 'a>, IoError> {
        let bytes = self.buffers.view(self.source, &self.root, range.view, place)?;
        let n_bytes = range.n_bytes as u64;
        let stride = self.root.buffer_views.get(range.view).and_then(|v| v.byte_stride);
        let stride = stride.map_or(range.n_bytes, |s| s.0);
        if stride < range.n_bytes {
            let problem = format!("a stride of {stride} for elements of {n_bytes} bytes");
            return Err(self.source.malformed(place, problem, REMEDY));
        }
        let length = match range.count {
            0 => 0,
            n => (n - 1).saturating_mul(stride as u64).saturating_add(n_bytes),
        };
        let end = range.offset.saturating_add(length);
        let Some(bytes) = bytes.get(range.offset as usize..end as usize) else {
            return Err(self.source.truncated(place, end, bytes.len() as u64));
        };
        Ok(bytes.chunks(stride).map(move |chunk| &chunk[..chunk.len().min(n_bytes as usize)]))
    }
}

/// Where elements are.
struct Range {
    view: usize,
    offset: u64,
    count: u64,
    /// Bytes of one element.
    n_bytes: usize,
}

/// The first `N` bytes, zero beyond the end (callers pass whole components).
fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
    bytes.first_chunk().copied().unwrap_or([0; N])
}

/// glTF 2.0 §3.11, "Animations", gives the normalization: c / max, and at least −1 if signed.
fn converter(component: ComponentType, normalized: bool) -> fn(&[u8]) -> f32 {
    use ComponentType as C;
    match (component, normalized) {
        (C::F32, _) => |b| f32::from_le_bytes(first(b)),
        (C::I8, false) => |b| i8::from_le_bytes(first(b)).into(),
        (C::U8, false) => |b| u8::from_le_bytes(first(b)).into(),
        (C::I16, false) => |b| i16::from_le_bytes(first(b)).into(),
        (C::U16, false) => |b| u16::from_le_bytes(first(b)).into(),
        (C::U32, false) => |b| u32::from_le_bytes(first(b)) as f32,
        (C::I8, true) => |b| (f32::from(i8::from_le_bytes(first(b))) / 127.0).max(-1.0),
        (C::U8, true) => |b| f32::from(u8::from_le_bytes(first(b))) / 255.0,
        (C::I16, true) => |b| (f32::from(i16::from_le_bytes(first(b))) / 32_767.0).max(-1.0),
        (C::U16, true) => |b| f32::from(u16::from_le_bytes(first(b))) / 65_535.0,
        (C::U32, true) => |b| (f64::from(u32::from_le_bytes(first(b))) / 4_294_967_295.0) as f32,
    }
}

fn integer_converter(component: ComponentType) -> Option<fn(&[u8]) -> u32> {
    match component {
        ComponentType::U8 => Some(|b| u8::from_le_bytes(first(b)).into()),
        ComponentType::U16 => Some(|b| u16::from_le_bytes(first(b)).into()),
        ComponentType::U32 => Some(|b| u32::from_le_bytes(first(b))),
        _ => None,
    }
}
