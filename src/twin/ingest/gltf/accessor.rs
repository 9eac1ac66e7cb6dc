//! Accessors: arrays of numbers in buffers.

use super::document::Document;

/// One attribute of all Gaussians.
pub(super) struct Column<'a> {
    pub(super) count: usize,
    bytes: &'a [u8],
    stride: usize,
    component: Component,
    normalized: bool,
}

#[derive(Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl<'a> Column<'a> {
    /// Finds an accessor with `width` numbers per row.
    ///
    /// # Errors
    /// Says why it cannot be used.
    pub(super) fn find(
        document: &Document,
        buffers: &[&'a [u8]],
        index: usize,
        width: usize,
    ) -> Result<Self, String> {
        let accessor =
            document.accessors.get(index).ok_or(format!("there is no accessor {index}"))?;
        let wanted = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        if accessor.kind != wanted {
            return Err(format!("accessor {index} is {:?}, not {wanted}", accessor.kind));
        }
        if accessor.sparse.is_some() {
            return Err(format!("accessor {index} is sparse; export it dense"));
        }
        let view = accessor
            .buffer_view
            .and_then(|view| document.buffer_views.get(view))
            .ok_or(format!("accessor {index} has no bufferView that exists"))?;
        if let Some(name) = view.extensions.keys().next() {
            return Err(format!("its bufferView is compressed by {name}; export it without"));
        }
        let component = Component::from_number(accessor.component_type)
            .ok_or(format!("componentType {} is not read", accessor.component_type))?;
        let row_bytes = (component.bytes() * width) as u64;
        let stride = view.byte_stride.unwrap_or(row_bytes);
        // glTF allows 4 to 252. A stride shorter than a row would make rows overlap, so that few
        // bytes become many rows.
        if stride < row_bytes || stride > 252 {
            return Err(format!("byteStride {stride}; {row_bytes} to 252 are possible"));
        }
        let buffer =
            *buffers.get(view.buffer).ok_or(format!("there is no buffer {}", view.buffer))?;
        let end = u128::from(stride) * u128::from(accessor.count.saturating_sub(1))
            + u128::from(if accessor.count == 0 { 0 } else { row_bytes })
            + u128::from(accessor.byte_offset);
        let view_end = u128::from(view.byte_offset) + u128::from(view.byte_length);
        if end > view.byte_length.into() || view_end > buffer.len() as u128 {
            return Err(format!(
                "{} rows of {stride} bytes from {} do not fit its bufferView, {} bytes from {} of \
                 buffer {} with {}",
                accessor.count,
                accessor.byte_offset,
                view.byte_length,
                view.byte_offset,
                view.buffer,
                buffer.len()
            ));
        }
        // Both offsets lie within the buffer by the checks above, so that the sum does not
        // overflow.
        let start = (view.byte_offset + accessor.byte_offset) as usize;
        Ok(Self {
            count: accessor.count as usize,
            bytes: &buffer[start..],
            stride: stride as usize,
            component,
            normalized: accessor.normalized,
        })
    }

    /// The first `N` numbers of a row.
    pub(super) fn row<const N: usize>(&self, index: usize) -> [f64; N] {
        let start = self.stride * index;
        let bytes = self.component.bytes();
        std::array::from_fn(|i| {
            // Of signed integers the smallest one stands for -1, as the next one does.
            let value = self.component.value(&self.bytes[start + bytes * i..]);
            if self.normalized { (value / self.component.most()).max(-1.0) } else { value }
        })
    }
}

impl Component {
    fn from_number(number: u32) -> Option<Self> {
        Some(match number {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::F32 => 4,
        }
    }

    /// The integer that stands for 1 where numbers are normalised.
    fn most(self) -> f64 {
        match self {
            Self::I8 => i8::MAX.into(),
            Self::U8 => u8::MAX.into(),
            Self::I16 => i16::MAX.into(),
            Self::U16 => u16::MAX.into(),
            Self::F32 => 1.0,
        }
    }

    fn value(self, bytes: &[u8]) -> f64 {
        match self {
            Self::I8 => (bytes[0] as i8).into(),
            Self::U8 => bytes[0].into(),
            Self::I16 => i16::from_le_bytes([bytes[0], bytes[1]]).into(),
            Self::U16 => u16::from_le_bytes([bytes[0], bytes[1]]).into(),
            Self::F32 => f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]).into(),
        }
    }
}
