//! The language of the types' texts: what the fields of a type are, and how a message of it is read. Refuses to know what
//! the hub publishes.

use crate::Type;

/// A type and those that it contains, as its text says.
#[derive(Clone, Debug)]
pub(crate) struct Layout<'a> {
    /// The type first; names without `msg`, such as `std_msgs/Header`.
    pub(crate) types: Vec<(&'a str, Vec<Field<'a>>)>,
}

/// A field of a type.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Field<'a> {
    pub(crate) name: &'a str,
    /// A word of the language, or the name of a type.
    pub(crate) of: &'a str,
    /// Whether there are any number of them, behind that number.
    pub(crate) is_sequence: bool,
}

impl<'a> Layout<'a> {
    /// Reads the text of `of`; the names of contained types must have their package.
    pub(crate) fn of(of: &'a Type) -> Layout<'a> {
        let types = of.text.split(Type::LINE).enumerate().map(|(place, text)| {
            let (name, fields) =
                if place == 0 { (of.name, text) } else { text.split_once('\n').unwrap_or((text, "")) };
            (name, fields.lines().filter_map(field).collect())
        });
        Layout { types: types.collect() }
    }

    /// The fields of the type `name`; nothing for a word of the language.
    pub(crate) fn fields(&self, name: &str) -> Option<&[Field<'a>]> {
        self.types.iter().find(|(of, _)| *of == name).map(|(_, fields)| &fields[..])
    }
}

/// A line: the type, the name, and perhaps a default, which does not travel.
fn field(line: &str) -> Option<Field<'_>> {
    let mut words = line.split_whitespace();
    let (of, name) = (words.next()?, words.next()?);
    let single = of.strip_suffix("[]");
    Some(Field { name, of: single.unwrap_or(of), is_sequence: single.is_some() })
}

/// A value of a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A number or a truth value.
    Number(f64),
    /// A text.
    Text(String),
    /// A sequence.
    Sequence(Vec<Value>),
    /// Fields with their names.
    Message(Vec<(String, Value)>),
}

impl Value {
    /// Returns the value at `path`: names of fields and places in sequences between dots, such as `transforms.0.header`.
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

/// Returns what is in `message` of type `of`; nothing if its bytes are fewer or more than the type's text demands.
pub fn read(of: &Type, message: &[u8]) -> Option<Value> {
    let body = message.strip_prefix(&[0, 1, 0, 0])?;
    let layout = Layout::of(of);
    let mut reader = Reader { layout: &layout, body, at: 0 };
    let value = reader.fields(layout.fields(of.name)?)?;
    (reader.at == body.len()).then_some(value)
}

/// A place in a message.
struct Reader<'a> {
    layout: &'a Layout<'a>,
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
            return self.one(field.of);
        }
        let count = self.count()?;
        (0..count).map(|_| self.one(field.of)).collect::<Option<_>>().map(Value::Sequence)
    }

    fn one(&mut self, of: &str) -> Option<Value> {
        Some(Value::Number(match of {
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

    /// A number of values that follow: each has at least a byte.
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
