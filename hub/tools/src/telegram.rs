//! `scanhub telegram`: explains the telegrams of an LMS in a recording, in a stream of bytes, or in hexadecimal text.
//!
//! `Input` provides the bytes, `StreamParser` splits them into items, and `ItemPrinter` writes the items as text or
//! as lines of JSON. Text in the input is detected by its first bytes, because raw bytes are hardly ever all printable.

mod parser;

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use scanhub_drivers::lms;
use scanhub_drivers::lms::explain::{Field, Headline, Value, explain};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{REPLY, Telegram};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_files::regular_file;
use scanhub_recording::{Encoding, Form, Frame, Recording};
use scanhub_schema::{Failure, Family, Kind, Printable};
use serde::Serialize;

use parser::{Item, StreamParser};

/// Explain telegrams of an LMS field by field
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct TelegramArgs {
    #[command(subcommand)]
    action: Action,
}

const EXAMPLES: &str = "\
Examples:
  scanhub telegram decode recording.bin
  echo 02 00 01 00 31 15 12 | scanhub telegram decode";

#[derive(Debug, Subcommand)]
enum Action {
    /// Explain the telegrams in a recording, in a pipe, or in text such as 02 00 01 00 31 15 12
    Decode(DecodeArgs),
}

#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
struct DecodeArgs {
    /// File to decode: raw bytes, bytes as text, or an MCAP recording. - or no file: stdin
    file: Option<PathBuf>,
    /// Decode only this sensor, if the recording has several
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Measuring mode of the values, for example 0x01 [default: the mode in the telegrams]
    #[arg(long, value_name = "BYTE")]
    mode: Option<String>,
    /// Print every value of long lists
    #[arg(long)]
    all: bool,
}

impl TelegramArgs {
    /// Explains all telegrams in a stream of bytes, in hexadecimal text or inside an MCAP recording, and reports the
    /// bytes between them. The bytes of a recording are those of its telegrams, in order.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Check`] if there is no telegram, [`Kind::Input`] if the input cannot be read, [`Kind::NoTopic`]
    /// if the recording does not have this sensor, and [`Kind::Usage`] if the recording has several sensors and the
    /// user has selected none.
    pub fn run(&self, json: bool, out: &mut dyn Write) -> Result<(), Failure> {
        let Action::Decode(args) = &self.action;
        decode(args, json, out)
    }
}

fn decode(args: &DecodeArgs, json: bool, out: &mut dyn Write) -> Result<(), Failure> {
    let requested = args.mode.as_deref().map(parse_mode).transpose()?;
    let file = args.file.as_deref().filter(|path| *path != Path::new("-"));
    let name = file.map_or("stdin".into(), |path| path.display().to_string());
    let (reader, of_recording): (Box<dyn Read>, _) = match (file, &args.sensor) {
        (Some(path), sensor) if sensor.is_some() || is_framed(path) => {
            open_recording(path, sensor.as_deref())?
        }
        (Some(path), _) => {
            (Box::new(regular_file::open(path).map_err(|error| unreadable(&name, &error))?), None)
        }
        (None, None) => (Box::new(io::stdin()), None),
        (None, Some(_)) => {
            let hint = "for example `scanhub telegram decode walk.mcap --sensor front`";
            return Err(Failure::new(
                Kind::Usage,
                "--sensor selects a sensor of a recording, and stdin is not one",
                hint,
            ));
        }
    };
    let mode = requested.or(of_recording);
    let mut input = Input::new(reader).map_err(|error| unreadable(&name, &error))?;
    let form = match (json, args.all) {
        (true, _) => OutputForm::Json,
        (false, all) => OutputForm::Text { all },
    };
    let mut printer = ItemPrinter::new(out, form, mode);
    let mut parser = StreamParser::default();
    let mut ended = Ok(());
    while ended.is_ok() {
        match input.next().map_err(|error| unreadable(&name, &error))? {
            Some(bytes) => ended = parser.feed(bytes, &mut |offset, item| printer.item(offset, item)),
            None => {
                ended = parser
                    .end(&mut |offset, item| printer.item(offset, item))
                    .and_then(|()| printer.print_summary());
                break;
            }
        }
    }
    match ended {
        // The reader of a pipe may close it at any time.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        Err(error) => Err(Failure::new(Kind::Failed, format!("cannot write: {error}"), "")),
        Ok(()) if printer.telegrams() == 0 => {
            let message = format!("{name}: no telegram in {} bytes", printer.bytes());
            let hint = "expected: raw bytes of an LMS, or text such as 02 00 01 00 31 15 12; packets of other families are \
                        not explained here: `scanhub convert FILE OUT.csv` has their scans";
            Err(Failure::new(Kind::Check, message, hint))
        }
        Ok(()) => Ok(()),
    }
}

/// Parses a measuring mode: `1`, `0x01` or `01h`.
fn parse_mode(text: &str) -> Result<Mode, Failure> {
    let hex = text.strip_prefix("0x").or(text.strip_prefix("0X")).or(text.strip_suffix(['h', 'H']));
    let (digits, radix) = hex.map_or((text, 10), |digits| (digits, 16));
    // `from_str_radix` accepts a sign.
    let byte = u8::from_str_radix(digits, radix).ok().filter(|_| !digits.starts_with('+'));
    byte.map(Mode).ok_or_else(|| {
        Failure::new(Kind::Configuration, format!("mode {text:?} is not a byte"), "for example --mode 0x01")
    })
}

fn unreadable(name: &str, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::Unsupported => "name its file: scanhub telegram decode FILE",
        ErrorKind::InvalidData => "write pairs of digits, as 02 80 03 00 or 0x02,0x80; text between quotes",
        _ => "name a readable file, or - for stdin",
    };
    Failure::new(Kind::Input, format!("{name}: {error}"), hint)
}

/// Input that is read in pieces. Hexadecimal text is converted to bytes.
pub(crate) struct Input {
    reader: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Number of bytes in the buffer that were read ahead.
    read_ahead: usize,
    is_text: bool,
}

impl Input {
    /// Reads the first piece, to detect its form.
    ///
    /// # Errors
    ///
    /// Returns [`ErrorKind::Unsupported`] if the input is an MCAP or gzip file.
    pub(crate) fn new(reader: Box<dyn Read>) -> io::Result<Input> {
        let mut input = Input { reader, buffer: vec![0; CHUNK_LEN], read_ahead: 0, is_text: false };
        input.read_ahead = input.read()?;
        let head = &input.buffer[..input.read_ahead];
        if Recording::is_framed(head) {
            let what = "telegrams inside MCAP or gzip cannot be read from a pipe";
            return Err(io::Error::new(ErrorKind::Unsupported, what));
        }
        input.is_text =
            !head.is_empty() && head.iter().all(|byte| byte.is_ascii_graphic() || byte.is_ascii_whitespace());
        Ok(input)
    }

    /// Returns the next bytes, or `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns [`ErrorKind::InvalidData`], with the line, if a part of hexadecimal text is not a byte.
    pub(crate) fn next(&mut self) -> io::Result<Option<&[u8]>> {
        let mut len = match std::mem::take(&mut self.read_ahead) {
            0 => self.read()?,
            len => len,
        };
        if len == 0 {
            return Ok(None);
        }
        if self.is_text {
            let mut text = self.buffer[..len].to_vec();
            self.reader.read_to_end(&mut text)?;
            let bytes = parse_hex(&String::from_utf8_lossy(&text))
                .map_err(|wrong| io::Error::new(ErrorKind::InvalidData, wrong))?;
            len = bytes.len();
            self.buffer = bytes;
            if len == 0 {
                return Ok(None);
            }
        }
        Ok(Some(&self.buffer[..len]))
    }

    fn read(&mut self) -> io::Result<usize> {
        if self.is_text {
            return Ok(0);
        }
        loop {
            match self.reader.read(&mut self.buffer) {
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                other => return other,
            }
        }
    }
}

/// Parses pairs of hexadecimal digits, with the usual separators and prefixes. Text between double quotes stands for
/// its own bytes.
fn parse_hex(text: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    for (line, text) in text.lines().enumerate() {
        for (number, part) in text.split('"').enumerate() {
            if number % 2 == 1 {
                bytes.extend(part.as_bytes());
                continue;
            }
            for word in part.split(|c: char| c.is_whitespace() || ",;:[]{}".contains(c)) {
                let digits = word.strip_prefix("0x").or(word.strip_prefix("0X")).unwrap_or(word);
                let digits = digits.strip_suffix(['h', 'H']).unwrap_or(digits);
                let pairs = digits.as_bytes().chunks(2).map(|pair| {
                    let pair = std::str::from_utf8(pair)
                        .ok()
                        .filter(|pair| pair.len() == 2 && !pair.starts_with('+'));
                    pair.and_then(|pair| u8::from_str_radix(pair, 16).ok())
                });
                let pairs = pairs.collect::<Option<Vec<_>>>();
                bytes.extend(pairs.ok_or_else(|| format!("line {}: {word:?} is not a byte", line + 1))?);
            }
        }
    }
    Ok(bytes)
}

/// Bytes, and the measuring mode of their values if the recording has it.
type RecordingInput = (Box<dyn Read>, Option<Mode>);

/// Returns whether the file at `path` is an MCAP or gzip file. Does not read a pipe, whose bytes would be lost.
fn is_framed(path: &Path) -> bool {
    let mut head = [0; 8];
    let is_file = path.metadata().is_ok_and(|metadata| metadata.is_file());
    is_file
        && File::open(path)
            .and_then(|mut file| file.read(&mut head))
            .is_ok_and(|len| Recording::is_framed(&head[..len]))
}

/// Returns the telegrams of `sensor` in the recording at `path`, as the bytes of a line. A recording of one sensor
/// needs no name.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the file cannot be read or has no telegrams, and [`Kind::NoTopic`] if it does not have
/// this sensor. Returns [`Kind::Usage`] if the file has several sensors and `sensor` is `None`, or if the file has no
/// sensor names and `sensor` is given.
fn open_recording(path: &Path, sensor: Option<&str>) -> Result<RecordingInput, Failure> {
    let mut recording = Recording::open_as(path, Some(Family::Lms))?;
    if let Some(sensor) = sensor {
        recording = recording.of(sensor)?;
    }
    let contents = recording.contents();
    if !contents.is_lms() {
        let family = recording.family().map_or("that this version does not have", Family::name);
        let message = format!(
            "{} has packets of a scanner of family {family}, not telegrams of an LMS",
            path.display()
        );
        return Err(Failure::new(Kind::Input, message, "`scanhub convert IN OUT.csv` makes scans of them"));
    }
    if !contents.damage.is_none() {
        tracing::warn!("{}: missing: {}", path.display(), contents.damage);
    }
    match contents.form {
        Form::Telegrams => Ok((recording.bytes()?, None)),
        Form::Mcap => {
            let mode = contents.mode;
            // The recording has telegrams, so the encoding is not used.
            let encoding = Encoding { unit: Unit::Mm, mode: mode.unwrap_or(Mode(0)) };
            let bytes =
                TelegramReader { telegrams: recording.telegrams(encoding)?, remaining: VecDeque::new() };
            Ok((Box::new(bytes), mode))
        }
        Form::Carmen => {
            let message = format!("{} is a CARMEN log, which has ranges and no telegrams", path.display());
            let hint = "`scanhub convert IN OUT.bin` makes telegrams of them";
            Err(Failure::new(Kind::Input, message, hint))
        }
    }
}

/// Reader of the bytes of telegrams.
struct TelegramReader {
    telegrams: Box<dyn Iterator<Item = Frame> + Send>,
    remaining: VecDeque<u8>,
}

impl Read for TelegramReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.remaining.is_empty() {
            self.remaining = self.telegrams.next().map(|frame| frame.telegram.into()).unwrap_or_default();
        }
        self.remaining.read(buffer)
    }
}

/// Form in which items are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OutputForm {
    /// Text for people.
    Text {
        /// Whether to write every value of a long list.
        all: bool,
    },
    /// One JSON object per line.
    Json,
}

/// Printer of items. It writes each item with one call, and counts the items.
pub(crate) struct ItemPrinter<'o> {
    out: &'o mut dyn Write,
    form: OutputForm,
    mode: Option<Mode>,
    /// Whether the user chose the mode. Otherwise, the mode is the one that the telegrams report.
    is_mode_chosen: bool,
    summary: Summary,
}

/// Class `summary`.
#[derive(Default, Serialize)]
struct Summary {
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
struct ItemLine {
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

impl<'o> ItemPrinter<'o> {
    /// Creates a printer to `out`. Values are split according to `mode`, or, without one, according to the mode that
    /// the telegrams report.
    pub(crate) fn new(out: &'o mut dyn Write, form: OutputForm, mode: Option<Mode>) -> ItemPrinter<'o> {
        let summary = Summary { class: "summary", ..Summary::default() };
        ItemPrinter { out, form, mode, is_mode_chosen: mode.is_some(), summary }
    }

    pub(crate) fn telegrams(&self) -> u64 {
        self.summary.telegrams
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.summary.bytes
    }

    /// Writes an item that starts at byte `offset` of the stream.
    pub(crate) fn item(&mut self, offset: u64, item: Item<'_>) -> io::Result<()> {
        let mut line = ItemLine { class: "decoded", offset, ..ItemLine::default() };
        let bytes: &[u8] = match item {
            Item::Telegram(telegram) => {
                self.summary.telegrams += 1;
                self.update_mode(telegram);
                line.kind = "telegram";
                line.from = Some(if telegram.is_reply() { "sensor" } else { "host" });
                line.address = Some(telegram.address() & !REPLY);
                line.command = Some(telegram.command());
                line.status = telegram.status();
                line.words = Headline(telegram).to_string();
                telegram.bytes()
            }
            Item::Broken { bytes, expected } => {
                self.summary.broken += 1;
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
                self.summary.cut += 1;
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
                self.summary.acknowledge += 1;
                (line.kind, line.words) = ("ack", "ACK: the sensor understood".to_owned());
                &[lms::telegram::ACK]
            }
            Item::Nak => {
                self.summary.acknowledge += 1;
                (line.kind, line.words) = ("nak", "NAK: the checksum of a request was wrong".to_owned());
                &[lms::telegram::NAK]
            }
            Item::Other(bytes) => {
                self.summary.other_bytes += bytes.len() as u64;
                (line.kind, line.words) = ("other", "in no telegram".to_owned());
                bytes
            }
        };
        line.length = bytes.len();
        self.summary.bytes += bytes.len() as u64;
        if matches!(item, Item::Broken { .. } | Item::Cut { .. } | Item::Other(_)) {
            self.summary.bytes_discarded += bytes.len() as u64;
        }
        let text = match self.form {
            OutputForm::Json => {
                if let Item::Telegram(telegram) = item {
                    explain(telegram, self.mode, &mut |field| line.fields.push(json(field)));
                }
                line.raw = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                scanhub_schema::json_line(serde_json::to_string(&line)?)
            }
            OutputForm::Text { all } => {
                let mut text = format!("{offset:>8}  {:4} bytes  {}", line.length, line.words);
                match item {
                    Item::Telegram(telegram) => {
                        explain(telegram, self.mode, &mut |field| text.push_str(&self::text(field, all)));
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

    /// Writes the totals.
    fn print_summary(&mut self) -> io::Result<()> {
        let Summary { bytes, telegrams, broken, cut, acknowledge, bytes_discarded, .. } = self.summary;
        let text = match self.form {
            OutputForm::Json => serde_json::to_string(&self.summary)?,
            OutputForm::Text { .. } => format!(
                "{bytes} bytes: {telegrams} telegrams, {broken} with a wrong checksum, {cut} broken off, \
                 {acknowledge} acknowledgements, {bytes_discarded} bytes in nothing"
            ),
        };
        self.out.write_all(format!("{text}\n").as_bytes())
    }

    /// Uses the mode that `telegram` reports, unless the user chose one.
    fn update_mode(&mut self, telegram: Telegram<'_>) {
        let reported = match Reply::decode(telegram) {
            Some(Reply::Status(report)) => report.mode(),
            Some(Reply::Configuration(configuration) | Reply::ConfigurationWritten { configuration, .. }) => {
                configuration.mode()
            }
            _ => return,
        };
        if !self.is_mode_chosen {
            self.mode = Some(reported);
        }
    }
}

fn describe_field(field: &Field<'_>) -> Option<String> {
    field.meaning.map(|words| words.to_string()).filter(|words| !words.is_empty())
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
            mm = Some(ranges.millimeters().map(Result::ok).collect());
            ranges.raw().collect()
        }
    };
    let Field { name, offset, bytes, .. } = *field;
    FieldLine { name, offset, length: bytes.len(), value, mm, words: describe_field(field) }
}

/// Returns a field as a line of text, or as several lines for a list.
fn text(field: &Field<'_>, all: bool) -> String {
    let mut text = format!("\n          {:>4}  {:<20}  {}", field.offset, hex(field.bytes, 6), field.name);
    let words = describe_field(field).map_or(String::new(), |words| format!(" ({words})"));
    let _ = match field.value {
        // Show only the meaning, because users do not know the numbers of these fields.
        Value::Number(_) if FRAME_FIELDS.contains(&field.name) => match describe_field(field) {
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
            let rows = ranges.raw().zip(ranges.millimeters()).zip(ranges.upper()).enumerate();
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

/// Returns at most `max` bytes in hexadecimal, with dots if there are more.
fn hex(bytes: &[u8], max: usize) -> String {
    let shown: Vec<_> = bytes.iter().take(max).map(|byte| format!("{byte:02X}")).collect();
    shown.join(" ") + if bytes.len() > max { " .." } else { "" }
}

/// Length of a piece that is read at once.
const CHUNK_LEN: usize = 16 * 1024;
/// Fields that are shown as bytes and meaning, but not as a number.
const FRAME_FIELDS: [&str; 6] = ["STX", "address", "command", "error", "status", "checksum"];

#[cfg(test)]
mod tests {
    use super::*;

    fn all(bytes: &'static [u8]) -> io::Result<Vec<u8>> {
        let mut input = Input::new(Box::new(bytes))?;
        let mut read = Vec::new();
        while let Some(bytes) = input.next()? {
            read.extend(bytes);
        }
        Ok(read)
    }

    #[test]
    fn reads_bytes_and_hexadecimal_text() {
        assert_eq!(all(&[2, 0x80, 3]).unwrap(), [2, 0x80, 3]);
        for text in
            ["02 80 03", "028003\n", "0x02,0x80, 0x03", "02h 80h\r\n03h", "[02;80:03]", "02 \"\" 80 03"]
        {
            assert_eq!(parse_hex(text).unwrap(), [2, 0x80, 3], "{text}");
        }
        assert_eq!(all(b"BA \"LMS\" 10").unwrap(), *b"\xBALMS\x10");
        assert!(all(b"").unwrap().is_empty());
        assert!(all(b" \n").unwrap().is_empty());
        let wrong = all(b"02 80\n03 4").unwrap_err();
        assert_eq!(
            (wrong.kind(), wrong.to_string().as_str()),
            (ErrorKind::InvalidData, "line 2: \"4\" is not a byte")
        );
        assert!(all(b"hello").is_err() && all(b"+1").is_err());
    }
}
