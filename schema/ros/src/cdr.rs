//! Little-endian CDR (OMG XCDR1): values in order, each at a multiple of its size from the start of the body. Refuses to
//! know types.

/// Writes a message.
pub(crate) struct Cdr<'a> {
    message: &'a mut Vec<u8>,
    body: usize,
}

impl Cdr<'_> {
    /// Begins a message at the end of `message`.
    pub(crate) fn begin(message: &mut Vec<u8>) -> Cdr<'_> {
        // Plain CDR, little-endian, no options.
        message.extend([0, 1, 0, 0]);
        let body = message.len();
        Cdr { message, body }
    }

    pub(crate) fn bool(&mut self, value: bool) {
        self.u8(value.into());
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.message.push(value);
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.value(value.to_le_bytes());
    }

    pub(crate) fn f32(&mut self, value: f32) {
        self.value(value.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, value: f64) {
        self.value(value.to_le_bytes());
    }

    pub(crate) fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.message.extend(text.as_bytes());
        self.message.push(0);
    }

    /// As many values as there are, behind their number.
    pub(crate) fn floats(&mut self, values: impl ExactSizeIterator<Item = f32>) {
        self.u32(values.len() as u32);
        values.for_each(|value| self.message.extend(value.to_le_bytes()));
    }

    /// Bytes of an array whose number is told already.
    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        self.message.extend(bytes);
    }

    /// `std_msgs/Header`. Seconds are an int32: from 2038 on they are cut.
    pub(crate) fn header(&mut self, stamp_ns: u64, frame: &str) {
        self.u32((stamp_ns / SECOND_NS) as u32);
        self.u32((stamp_ns % SECOND_NS) as u32);
        self.text(frame);
    }

    fn value<const SIZE: usize>(&mut self, bytes: [u8; SIZE]) {
        let end = self.body + (self.message.len() - self.body).next_multiple_of(SIZE);
        self.message.resize(end, 0);
        self.message.extend(bytes);
    }
}

const SECOND_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_stand_at_multiples_of_their_size() {
        // What is there already does not count.
        let mut message = vec![9; 3];
        let mut cdr = Cdr::begin(&mut message);
        cdr.text("ab");
        cdr.u32(7);
        cdr.f64(1.0);
        let body: Vec<u8> =
            [&[3, 0, 0, 0, b'a', b'b', 0, 0, 7, 0, 0, 0], &[0; 4][..], &1f64.to_le_bytes()].concat();
        assert_eq!(message[3..7], [0, 1, 0, 0]);
        assert_eq!(message[7..], body);
    }
}
