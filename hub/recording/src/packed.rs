//! A gzip file as the bytes that it unpacks to. A kilobyte can unpack to a megabyte of the same byte: what cannot be a
//! recording is refused early. Refuses to know what the bytes are.

use std::io::{self, BufRead, ErrorKind, Read};

use flate2::bufread::MultiGzDecoder;

/// Unpacks `R`.
pub(crate) struct Packed<R> {
    decoder: MultiGzDecoder<Counted<R>>,
    /// Bytes that came out.
    unpacked: u64,
}

/// Counts what is read.
struct Counted<R> {
    input: R,
    read: u64,
}

impl<R: BufRead> Packed<R> {
    pub(crate) fn new(input: R) -> Self {
        Packed { decoder: MultiGzDecoder::new(Counted { input, read: 0 }), unpacked: 0 }
    }
}

impl<R: BufRead> Read for Packed<R> {
    /// [`ErrorKind::FileTooLarge`] where it unpacks to [`MOST_TIMES`] its length.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let len = self.decoder.read(buffer)?;
        self.unpacked += len as u64;
        let most = self.decoder.get_ref().read.saturating_mul(MOST_TIMES).max(ALWAYS);
        if self.unpacked > most {
            let what =
                format!("it unpacks to more than {MOST_TIMES} times its length, which no recording does");
            return Err(io::Error::new(ErrorKind::FileTooLarge, what));
        }
        Ok(len)
    }
}

impl<R: BufRead> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let len = self.input.read(buffer)?;
        self.read += len as u64;
        Ok(len)
    }
}

impl<R: BufRead> BufRead for Counted<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.input.fill_buf()
    }

    fn consume(&mut self, len: usize) {
        self.read += len as u64;
        self.input.consume(len);
    }
}

/// One telegram again and again becomes a hundredth; the format itself can do a thousandth.
const MOST_TIMES: u64 = 400;
/// Unpacked however short the file is.
const ALWAYS: u64 = 32 << 20;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;

    fn packed(byte: impl Fn(usize) -> u8, len: usize) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        for begin in (0..len).step_by(1 << 16) {
            let piece: Vec<u8> = (begin..len.min(begin + (1 << 16))).map(&byte).collect();
            encoder.write_all(&piece).unwrap();
        }
        encoder.finish().unwrap()
    }

    /// Bytes that came out, and how it ended.
    fn unpacked(packed: &[u8]) -> (usize, Result<(), ErrorKind>) {
        let (mut input, mut buffer, mut len) = (Packed::new(packed), vec![0; 1 << 16], 0);
        loop {
            match input.read(&mut buffer) {
                Ok(0) => return (len, Ok(())),
                Ok(read) => len += read,
                Err(error) => return (len, Err(error.kind())),
            }
        }
    }

    #[test]
    fn what_unpacks_to_too_much_is_refused_early() {
        let most = ALWAYS as usize;
        assert_eq!(unpacked(&packed(|_| 0, most)), (most, Ok(())), "short enough in any case");
        let (len, end) = unpacked(&packed(|_| 0, 3 * most));
        assert!(len <= most && end == Err(ErrorKind::FileTooLarge), "{len} {end:?}");
        // The telegram of an empty room, which a line brings all day.
        let telegram = |at: usize| (at % 732) as u8 ^ ((at % 732) >> 8) as u8;
        assert_eq!(unpacked(&packed(telegram, 2 * most)), (2 * most, Ok(())));
    }
}
