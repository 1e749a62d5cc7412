//! Raw bytes of a line, or bytes written in hexadecimal: detected from the first bytes, because raw bytes are hardly ever
//! all letters. Knows no telegrams.

use std::io::{self, ErrorKind, Read};

use recording::Recording;

/// Where bytes come from, piece by piece.
pub(super) struct Input {
    reader: Box<dyn Read>,
    buffer: Vec<u8>,
    /// Bytes of the buffer that were read ahead.
    ahead: usize,
    is_text: bool,
}

impl Input {
    /// Reads the first piece, to see what it is. [`ErrorKind::Unsupported`] if it has telegrams inside something else.
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

    /// The next bytes, `None` at the end. [`ErrorKind::InvalidData`] names the line and what is no byte.
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

/// Pairs of digits with anything usual between them; text between double quotes is itself.
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

const PIECE: usize = 16 * 1024;

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
