//! The bytes to decode, from raw bytes, hexadecimal text or a recording. Text is detected by its first bytes, because
//! raw bytes are hardly ever all printable characters.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::path::Path;

use recording::{Encoding, Form, Frame, Recording};
use scanhub_drivers::lms::variant::{Mode, Unit};
use schema::{Failure, Family, Kind};

/// Length of a piece that is read at once.
const PIECE: usize = 16 * 1024;

/// Reads bytes in pieces, and converts hexadecimal text.
pub(super) struct Input {
    reader: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Number of bytes in the buffer that were read ahead.
    ahead: usize,
    is_text: bool,
}

impl Input {
    /// Reads the first piece, to detect its form.
    ///
    /// # Errors
    ///
    /// Returns [`ErrorKind::Unsupported`] if the input is an MCAP or gzip file.
    pub(super) fn new(reader: Box<dyn Read>) -> io::Result<Input> {
        let mut input = Input { reader, buffer: vec![0; PIECE], ahead: 0, is_text: false };
        input.ahead = input.read()?;
        let head = &input.buffer[..input.ahead];
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
    /// Returns [`ErrorKind::InvalidData`], with the line, if a word of hexadecimal text is not a byte.
    pub(super) fn next(&mut self) -> io::Result<Option<&[u8]>> {
        let mut len = match std::mem::take(&mut self.ahead) {
            0 => self.read()?,
            len => len,
        };
        if len == 0 {
            return Ok(None);
        }
        if self.is_text {
            let mut text = self.buffer[..len].to_vec();
            self.reader.read_to_end(&mut text)?;
            let bytes = parse(&String::from_utf8_lossy(&text))
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
pub(super) fn parse(text: &str) -> Result<Vec<u8>, String> {
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
                bytes.extend(pairs.ok_or_else(|| format!("line {}: {word:?} is no byte", line + 1))?);
            }
        }
    }
    Ok(bytes)
}

/// Bytes, and the measuring mode of their values if the recording has it.
type Unpacked = (Box<dyn Read>, Option<Mode>);

/// Returns whether the file at `path` is an MCAP or gzip file. Does not read a pipe, whose bytes would be lost.
pub(super) fn is_framed(path: &Path) -> bool {
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
/// Returns [`Kind::Input`] if the file cannot be read or has no telegrams, [`Kind::NoTopic`] if it does not have this
/// sensor, and [`Kind::Usage`] if a name is missing, or is given although the file has none.
pub(super) fn open_recording(path: &Path, sensor: Option<&str>) -> Result<Unpacked, Failure> {
    let mut recording = Recording::open_as(path, Some(Family::Lms))?;
    if let Some(sensor) = sensor {
        recording = recording.of(sensor)?;
    }
    let contents = recording.contents();
    if !contents.is_lms() {
        let family = recording.family().map_or("that is not known here", Family::name);
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
            let bytes = Bytes { telegrams: recording.telegrams(encoding)?, left: VecDeque::new() };
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
struct Bytes {
    telegrams: Box<dyn Iterator<Item = Frame> + Send>,
    left: VecDeque<u8>,
}

impl Read for Bytes {
    fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
        if self.left.is_empty() {
            self.left = self.telegrams.next().map(|frame| frame.telegram.into()).unwrap_or_default();
        }
        self.left.read(room)
    }
}

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
    fn bytes_and_what_is_written_for_them() {
        assert_eq!(all(&[2, 0x80, 3]).unwrap(), [2, 0x80, 3]);
        for text in
            ["02 80 03", "028003\n", "0x02,0x80, 0x03", "02h 80h\r\n03h", "[02;80:03]", "02 \"\" 80 03"]
        {
            assert_eq!(parse(text).unwrap(), [2, 0x80, 3], "{text}");
        }
        assert_eq!(all(b"BA \"LMS\" 10").unwrap(), *b"\xBALMS\x10");
        assert!(all(b"").unwrap().is_empty());
        assert!(all(b" \n").unwrap().is_empty());
        let wrong = all(b"02 80\n03 4").unwrap_err();
        assert_eq!(
            (wrong.kind(), wrong.to_string().as_str()),
            (ErrorKind::InvalidData, "line 2: \"4\" is no byte")
        );
        assert!(all(b"hello").is_err() && all(b"+1").is_err());
    }
}
