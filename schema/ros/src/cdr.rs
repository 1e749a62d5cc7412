//! Writer and reader of messages in little-endian CDR (OMG XCDR1): values in order, each at a multiple of its size from
//! the start of the body.

use crate::types::{Field, MessageDef, Type};

/// Writes a message.
pub(crate) struct Cdr<'a> {
    message: &'a mut Vec<u8>,
    body: usize,
}

impl Cdr<'_> {
    /// Starts a message at the end of `message`.
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

    /// Writes a sequence: the number of `values`, then the values.
    pub(crate) fn floats(&mut self, values: impl ExactSizeIterator<Item = f32>) {
        self.u32(values.len() as u32);
        values.for_each(|value| self.message.extend(value.to_le_bytes()));
    }

    /// Writes bytes of a sequence whose length is already written.
    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        self.message.extend(bytes);
    }

    /// Writes a `std_msgs/Header`. Its seconds are an int32, which overflows in 2038.
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

/// A value of a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A number or a boolean.
    Number(f64),
    /// A text.
    Text(String),
    /// A sequence.
    Sequence(Vec<Value>),
    /// Fields with their names.
    Message(Vec<(String, Value)>),
}

impl Value {
    /// Returns the value at `path`: names of fields and indices of sequences, separated by dots, such as
    /// `transforms.0.header`.
    pub fn at(&self, path: &str) -> Option<&Value> {
        path.split('.').try_fold(self, |value, step| match value {
            Value::Message(fields) => fields.iter().find(|(name, _)| name == step).map(|(_, value)| value),
            Value::Sequence(values) => values.get(step.parse::<usize>().ok()?),
            Value::Number(_) | Value::Text(_) => None,
        })
    }

    /// Returns the number at `path`.
    pub fn number(&self, path: &str) -> Option<f64> {
        match self.at(path)? {
            Value::Number(number) => Some(*number),
            _ => None,
        }
    }

    /// Returns the text at `path`.
    pub fn text(&self, path: &str) -> Option<&str> {
        match self.at(path)? {
            Value::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the sequence at `path`.
    pub fn sequence(&self, path: &str) -> Option<&[Value]> {
        match self.at(path)? {
            Value::Sequence(values) => Some(values),
            _ => None,
        }
    }
}

/// Decodes `message` of type `message_type`. Returns `None` if `message` has fewer or more bytes than its type
/// requires.
pub fn read(message_type: &Type, message: &[u8]) -> Option<Value> {
    let body = message.strip_prefix(&[0, 1, 0, 0])?;
    let layout = MessageDef::of(message_type);
    let mut reader = Reader { layout: &layout, body, at: 0 };
    let value = reader.fields(layout.fields(message_type.name)?)?;
    (reader.at == body.len()).then_some(value)
}

/// A position in a message.
struct Reader<'a> {
    layout: &'a MessageDef<'a>,
    body: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn fields(&mut self, fields: &[Field<'_>]) -> Option<Value> {
        let values = fields.iter().map(|field| Some((field.name.to_owned(), self.field(field)?)));
        values.collect::<Option<_>>().map(Value::Message)
    }

    fn field(&mut self, field: &Field<'_>) -> Option<Value> {
        if !field.is_sequence {
            return self.value_of(field.type_name);
        }
        let count = self.count()?;
        (0..count).map(|_| self.value_of(field.type_name)).collect::<Option<_>>().map(Value::Sequence)
    }

    fn value_of(&mut self, type_name: &str) -> Option<Value> {
        Some(Value::Number(match type_name {
            "bool" | "byte" | "uint8" => u8::from_le_bytes(self.take()?).into(),
            "int32" => i32::from_le_bytes(self.take()?).into(),
            "uint32" => u32::from_le_bytes(self.take()?).into(),
            "float32" => f32::from_le_bytes(self.take()?).into(),
            "float64" => f64::from_le_bytes(self.take()?),
            "string" => return self.text().map(Value::Text),
            name => return self.fields(self.layout.fields(name)?),
        }))
    }

    fn text(&mut self) -> Option<String> {
        let bytes = self.count()?;
        let text = self.body.get(self.at..self.at + bytes)?;
        self.at += bytes;
        String::from_utf8(text.strip_suffix(&[0])?.to_vec()).ok()
    }

    /// Reads the number of values that follow. Each value has at least one byte, so the number must not exceed the
    /// number of remaining bytes.
    fn count(&mut self) -> Option<usize> {
        let count = u32::from_le_bytes(self.take()?) as usize;
        (count <= self.body.len() - self.at).then_some(count)
    }

    fn take<const SIZE: usize>(&mut self) -> Option<[u8; SIZE]> {
        let begin = self.at.next_multiple_of(SIZE);
        let bytes = self.body.get(begin..begin + SIZE)?;
        self.at = begin + SIZE;
        bytes.try_into().ok()
    }
}

const SECOND_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_aligned_to_their_size() {
        // Positions are relative to the start of the message, so these bytes before the message change nothing.
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
