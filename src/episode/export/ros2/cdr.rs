//! CDR, the encoding of ROS 2's messages: little endian, each number at a multiple of its size from
//! the end of the header (OMG DDS-XTypes, plain CDR version 1).

/// The header of plain CDR in little endian.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// The bytes of a message.
pub(super) struct Cdr {
    bytes: Vec<u8>,
}

impl Cdr {
    pub(super) fn new() -> Self {
        Self { bytes: HEADER.to_vec() }
    }

    pub(super) fn finish(self) -> Vec<u8> {
        self.bytes
    }

    pub(super) fn put_u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    pub(super) fn put_bool(&mut self, value: bool) {
        self.put_u8(value.into());
    }

    pub(super) fn put_i32(&mut self, value: i32) {
        self.put(value.to_le_bytes());
    }

    pub(super) fn put_u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    pub(super) fn put_f64(&mut self, value: f64) {
        self.put(value.to_le_bytes());
    }

    /// An array of a fixed length.
    pub(super) fn put_array(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.put_f64(*value));
    }

    /// A sequence of any length.
    pub(super) fn put_sequence(&mut self, values: &[f64]) {
        self.put_len(values.len());
        self.put_array(values);
    }

    /// The number of elements of a sequence, which follow.
    pub(super) fn put_len(&mut self, len: usize) {
        // Longer sequences do not occur: a message of MCAP has at most 4 GiB.
        self.put_u32(u32::try_from(len).unwrap_or(u32::MAX));
    }

    pub(super) fn put_bytes(&mut self, bytes: &[u8]) {
        self.put_len(bytes.len());
        self.bytes.extend(bytes);
    }

    /// A text with the zero byte at its end, which counts.
    pub(super) fn put_text(&mut self, text: &str) {
        self.put_len(text.len() + 1);
        self.bytes.extend(text.bytes());
        self.bytes.push(0);
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        let after_header = self.bytes.len() - HEADER.len();
        let padding = after_header.next_multiple_of(N) - after_header;
        self.bytes.resize(self.bytes.len() + padding, 0);
        self.bytes.extend(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_aligned_after_the_header() {
        let mut cdr = Cdr::new();
        cdr.put_text("ab");
        cdr.put_f64(1.0);
        cdr.put_bool(true);
        cdr.put_u32(7);
        let mut expected = vec![0, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0, 0];
        // 8 bytes after the header: a multiple of 8 already.
        expected.extend(1.0_f64.to_le_bytes());
        expected.extend([1, 0, 0, 0, 7, 0, 0, 0]);
        assert_eq!(cdr.finish(), expected);
    }
}
