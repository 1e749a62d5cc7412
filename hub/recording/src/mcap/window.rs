//! A moving window over a file of any length, which holds only a part of it in memory. A file that is cut, also inside its
//! compression, ends there. Refuses to know what the bytes are.

use std::io::{self, Read};

use crate::open::is_end;

/// The view; positions count from the beginning of the file.
pub(crate) struct Window<R> {
    input: R,
    bytes: Vec<u8>,
    /// Position of the first byte that is held.
    base: u64,
    is_ended: bool,
}

impl<R: Read> Window<R> {
    pub(crate) fn new(input: R) -> Self {
        Window { input, bytes: Vec::new(), base: 0, is_ended: false }
    }

    /// The bytes at `at`, `wanted` or more; fewer only at the end of the file, none if they were released.
    pub(crate) fn bytes(&mut self, at: u64, wanted: usize) -> io::Result<&[u8]> {
        let Some(skipped) = at.checked_sub(self.base).and_then(|skipped| usize::try_from(skipped).ok())
        else {
            return Ok(&[]);
        };
        while !self.is_ended && self.bytes.len() < skipped.saturating_add(wanted) {
            self.read()?;
        }
        Ok(self.bytes.get(skipped..).unwrap_or_default())
    }

    /// Bytes before `at` are not needed any more.
    pub(crate) fn release(&mut self, at: u64) {
        let done = at.saturating_sub(self.base) as usize;
        if done >= PIECE && done >= self.bytes.len() / 2 {
            let done = done.min(self.bytes.len());
            self.bytes.drain(..done);
            self.base += done as u64;
        }
    }

    fn read(&mut self) -> io::Result<()> {
        let len = self.bytes.len();
        self.bytes.resize(len + PIECE, 0);
        let read = loop {
            match self.input.read(&mut self.bytes[len..]) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                other => break other,
            }
        };
        self.bytes.truncate(len + *read.as_ref().unwrap_or(&0));
        match read {
            Ok(read) => self.is_ended = read == 0,
            // A gzip file that is cut or harmed.
            Err(error) if is_end(&error) => self.is_ended = true,
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

/// Bytes read at a time.
const PIECE: usize = 256 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_moves_on() {
        let file: Vec<u8> = (0..3 * PIECE + 5).map(|i| i as u8).collect();
        let mut window = Window::new(&file[..]);
        assert_eq!(window.bytes(0, 8).unwrap()[..8], file[..8]);
        let at = 2 * PIECE + 17;
        assert_eq!(window.bytes(at as u64, 40).unwrap()[..40], file[at..at + 40]);
        window.release(at as u64);
        assert_eq!(window.bytes(at as u64 - 1, 1).unwrap(), [0u8; 0]);
        assert!(window.bytes.len() <= 2 * PIECE);
        assert_eq!(*window.bytes(at as u64, usize::MAX).unwrap(), file[at..]);
        assert_eq!(window.bytes(u64::MAX, 1).unwrap(), [0u8; 0]);
    }
}
