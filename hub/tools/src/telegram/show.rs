//! The items found, as text for people or as lines of JSON. Each item is written with one call.

use std::fmt::Write as _;
use std::io::{self, Write};

use scanhub_drivers::lms;
use scanhub_drivers::lms::explain::{Field, Headline, Value, explain};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{REPLY, Telegram};
use scanhub_drivers::lms::variant::Mode;
use schema::Printable;
use serde::Serialize;

use super::find::Item;

/// How items are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// For people.
    Text {
        /// Every value of a long list.
        all: bool,
    },
    /// One object a line.
    Json,
}

/// Writes items, and counts them.
pub(super) struct Show<'o> {
    out: &'o mut dyn Write,
    form: Form,
    mode: Option<Mode>,
    /// Whether the mode was said, and is not learned.
    mode_said: bool,
    account: Account,
}

/// Class `summary`.
#[derive(Default, Serialize)]
struct Account {
    class: &'static str,
    bytes: u64,
    telegrams: u64,
    broken: u64,
    cut: u64,
    acknowledge: u64,
    other_bytes: u64,
    bytes_discarded: u64,
}

/// Class `decoded`.
#[derive(Default, Serialize)]
struct Line {
    class: &'static str,
    offset: u64,
    kind: &'static str,
    length: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    address: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    command: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    status: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    checksum: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    expected: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    announced: Option<usize>,
    words: String,
    fields: Vec<FieldLine>,
    raw: String,
}

#[derive(Serialize)]
struct FieldLine {
    name: &'static str,
    offset: usize,
    length: usize,
    value: serde_json::Value,
    #[serde(skip_serializing_if = "Option::is_none")]
    mm: Option<Vec<Option<u32>>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    words: Option<String>,
}

impl<'o> Show<'o> {
    /// Items to `out`; values are read as `mode` splits them, or as the telegrams tell.
    pub(super) fn new(out: &'o mut dyn Write, form: Form, mode: Option<Mode>) -> Show<'o> {
        let account = Account { class: "summary", ..Account::default() };
        Show { out, form, mode, mode_said: mode.is_some(), account }
    }

    pub(super) fn telegrams(&self) -> u64 {
        self.account.telegrams
    }

    pub(super) fn bytes(&self) -> u64 {
        self.account.bytes
    }

    /// Writes an item that begins at byte `offset` of the stream.
    pub(super) fn item(&mut self, offset: u64, item: Item<'_>) -> io::Result<()> {
        let mut line = Line { class: "decoded", offset, ..Line::default() };
        let bytes: &[u8] = match item {
            Item::Telegram(telegram) => {
                self.account.telegrams += 1;
                self.learn(telegram);
                line.kind = "telegram";
                line.from = Some(if telegram.is_reply() { "sensor" } else { "host" });
                line.address = Some(telegram.address() & !REPLY);
                line.command = Some(telegram.command());
                line.status = telegram.status();
                line.words = Headline(telegram).to_string();
                telegram.bytes()
            }
            Item::Broken { bytes, expected } => {
                self.account.broken += 1;
                let found = u16::from_le_bytes([bytes[bytes.len() - 2], bytes[bytes.len() - 1]]);
                line.kind = "broken";
                line.command = Some(bytes[4]);
                (line.checksum, line.expected) = (Some(found), Some(expected));
                line.words = format!(
                    "a telegram {:02X}h with the checksum {found:04X}, its bytes have {expected:04X}",
                    bytes[4]
                );
                bytes
            }
            Item::Cut { bytes, announced } => {
                self.account.cut += 1;
                line.kind = "cut";
                line.command = Some(bytes[4]);
                line.announced = Some(announced);
                line.words = format!(
                    "the head of a telegram {:02X}h of {announced} bytes that broke off, or was none",
                    bytes[4]
                );
                bytes
            }
            Item::Ack => {
                self.account.acknowledge += 1;
                (line.kind, line.words) = ("ack", "ACK: the sensor understood".to_owned());
                &[lms::telegram::ACK]
            }
            Item::Nak => {
                self.account.acknowledge += 1;
                (line.kind, line.words) = ("nak", "NAK: the checksum of a request was wrong".to_owned());
                &[lms::telegram::NAK]
            }
            Item::Other(bytes) => {
                self.account.other_bytes += bytes.len() as u64;
                (line.kind, line.words) = ("other", "in no telegram".to_owned());
                bytes
            }
        };
        line.length = bytes.len();
        self.account.bytes += bytes.len() as u64;
        if matches!(item, Item::Broken { .. } | Item::Cut { .. } | Item::Other(_)) {
            self.account.bytes_discarded += bytes.len() as u64;
        }
        let text = match self.form {
            Form::Json => {
                if let Item::Telegram(telegram) = item {
                    explain(telegram, self.mode, &mut |field| line.fields.push(json(field)));
                }
                line.raw = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                schema::json_line(serde_json::to_string(&line)?)
            }
            Form::Text { all } => {
                let mut text = format!("{offset:>8}  {:4} bytes  {}", line.length, line.words);
                match item {
                    Item::Telegram(telegram) => {
                        explain(telegram, self.mode, &mut |field| text.push_str(&people(field, all)));
                    }
                    Item::Ack | Item::Nak => {}
                    _ => {
                        let _ = write!(text, ": {}", hex(bytes, if all { usize::MAX } else { 16 }));
                    }
                }
                text
            }
        };
        self.out.write_all(format!("{}\n", Printable(&text)).as_bytes())
    }

    /// Writes what there was in all.
    pub(super) fn summary(&mut self) -> io::Result<()> {
        let Account { bytes, telegrams, broken, cut, acknowledge, bytes_discarded, .. } = self.account;
        let text = match self.form {
            Form::Json => serde_json::to_string(&self.account)?,
            Form::Text { .. } => format!(
                "{bytes} bytes: {telegrams} telegrams, {broken} with a wrong checksum, {cut} broken off, \
                 {acknowledge} acknowledgements, {bytes_discarded} bytes in nothing"
            ),
        };
        self.out.write_all(format!("{text}\n").as_bytes())
    }

    fn learn(&mut self, telegram: Telegram<'_>) {
        let told = match Reply::decode(telegram) {
            Some(Reply::Status(report)) => report.mode(),
            Some(Reply::Configuration(configuration) | Reply::ConfigurationWritten { configuration, .. }) => {
                configuration.mode()
            }
            _ => return,
        };
        if !self.mode_said {
            self.mode = Some(told);
        }
    }
}

fn words_of(field: &Field<'_>) -> Option<String> {
    field.words.map(|words| words.to_string()).filter(|words| !words.is_empty())
}

fn json(field: &Field<'_>) -> FieldLine {
    let mut mm = None;
    let value = match field.value {
        Value::Number(number) => number.into(),
        Value::Text(text) => String::from_utf8_lossy(text).into(),
        Value::Bytes(bytes) => bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>().into(),
        Value::Rows { bytes, columns } => {
            let words = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
            let words: Vec<u16> = words.collect();
            match columns.len() {
                1 => words.into(),
                columns => words.chunks_exact(columns).map(serde_json::Value::from).collect(),
            }
        }
        Value::Ranges(ranges) => {
            mm = Some(ranges.millimetres().map(Result::ok).collect());
            ranges.raw().collect()
        }
    };
    let Field { name, offset, bytes, .. } = *field;
    FieldLine { name, offset, length: bytes.len(), value, mm, words: words_of(field) }
}

/// A line, or several for a list.
fn people(field: &Field<'_>, all: bool) -> String {
    let mut text = format!("\n          {:>4}  {:<20}  {}", field.offset, hex(field.bytes, 6), field.name);
    let words = words_of(field).map_or(String::new(), |words| format!(" ({words})"));
    let _ = match field.value {
        // What only has to be there, or has no number in mind.
        Value::Number(_) if FRAME.contains(&field.name) => match words_of(field) {
            Some(words) => write!(text, ": {words}"),
            None => Ok(()),
        },
        Value::Number(number) => write!(text, ": {number}{words}"),
        Value::Text(chars) => write!(text, ": \"{}\"", chars.escape_ascii()),
        Value::Bytes(bytes) if all && bytes.len() > 6 => write!(text, ": {}", hex(bytes, usize::MAX)),
        Value::Bytes(_) => Ok(()),
        Value::Rows { bytes, columns } => rows(&mut text, bytes, columns, all),
        Value::Ranges(ranges) => {
            let _ = write!(text, ": {} values{words}", ranges.raw().len());
            let rows = ranges.raw().zip(ranges.millimetres()).zip(ranges.upper()).enumerate();
            for (beam, ((raw, range), upper)) in rows.take(if all { usize::MAX } else { 0 }) {
                let range = range.map_or_else(|code| code.to_string(), |mm| format!("{mm} mm"));
                let _ = write!(text, "\n                {beam:>4}  {raw:04X}  {range}, bits above {upper}");
            }
            Ok(())
        }
    };
    text
}

fn rows(text: &mut String, bytes: &[u8], columns: &[&str], all: bool) -> std::fmt::Result {
    let words = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
    let words: Vec<u16> = words.collect();
    if columns.len() == 1 {
        let words: Vec<_> = words.iter().map(u16::to_string).collect();
        return write!(text, ": {}", words.join(" "));
    }
    write!(text, ": {} rows of {}", words.len() / columns.len(), columns.join(", "))?;
    for (row, words) in words.chunks_exact(columns.len()).enumerate().take(if all { usize::MAX } else { 0 }) {
        let words: Vec<_> = words.iter().map(u16::to_string).collect();
        write!(text, "\n                {row:>4}  {}", words.join(", "))?;
    }
    Ok(())
}

/// Fields of which people read the bytes, or the words.
const FRAME: [&str; 6] = ["STX", "address", "command", "error", "status", "checksum"];

/// At most `most` bytes, and whether there are more.
fn hex(bytes: &[u8], most: usize) -> String {
    let shown: Vec<_> = bytes.iter().take(most).map(|byte| format!("{byte:02X}")).collect();
    shown.join(" ") + if bytes.len() > most { " .." } else { "" }
}
