//! A walk through the bytes of a telegram that never steps over its end and never leaves a byte out.

use super::Ranges;
use core::fmt::{self, Display};

/// A part of a telegram.
pub struct Field<'a> {
    /// Its first byte, counted from STX.
    pub offset: usize,
    /// Its bytes.
    pub bytes: &'a [u8],
    /// What it is.
    pub name: &'static str,
    /// What it says.
    pub value: Value<'a>,
    /// The same in words, where there are any.
    pub words: Option<&'a dyn Display>,
}

/// What a field says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Value<'a> {
    /// A number, low byte first.
    Number(u32),
    /// Characters.
    Text(&'a [u8]),
    /// Bytes without a layout.
    Bytes(&'a [u8]),
    /// Rows of words, a word for each column.
    Rows {
        /// All rows.
        bytes: &'a [u8],
        /// What the words of a row are.
        columns: &'static [&'static str],
    },
    /// Measured values.
    Ranges(Ranges<'a>),
}

pub(super) struct Walk<'t, 'v> {
    bytes: &'t [u8],
    at: usize,
    end: usize,
    visit: &'v mut dyn FnMut(&Field<'_>),
}

impl<'t, 'v> Walk<'t, 'v> {
    pub(super) fn new(bytes: &'t [u8], visit: &'v mut dyn FnMut(&Field<'_>)) -> Self {
        Walk { bytes, at: 0, end: 0, visit }
    }

    /// The fields that follow end at `end`.
    pub(super) fn open(&mut self, end: usize) {
        self.end = end;
    }

    /// Tells what nobody asked for as bytes, up to the last `len` bytes of the telegram, which follow.
    pub(super) fn leave(&mut self, len: usize) {
        self.end = self.bytes.len() - len;
        self.rest("data");
        self.end = self.bytes.len();
    }

    /// Bytes that are left of the layout.
    pub(super) fn left(&self) -> usize {
        self.end - self.at
    }

    pub(super) fn byte(&mut self, name: &'static str) -> Option<u8> {
        self.number(name, 1, None::<fn(u32) -> &'static str>).map(|value| value as u8)
    }

    pub(super) fn byte_as<D: Display>(
        &mut self,
        name: &'static str,
        words: impl FnOnce(u8) -> D,
    ) -> Option<u8> {
        self.number(name, 1, Some(|value| words(value as u8))).map(|value| value as u8)
    }

    pub(super) fn word(&mut self, name: &'static str) -> Option<u16> {
        self.number(name, 2, None::<fn(u32) -> &'static str>).map(|value| value as u16)
    }

    pub(super) fn word_as<D: Display>(
        &mut self,
        name: &'static str,
        words: impl FnOnce(u16) -> D,
    ) -> Option<u16> {
        self.number(name, 2, Some(|value| words(value as u16))).map(|value| value as u16)
    }

    /// A number of one to four bytes.
    pub(super) fn number<D: Display>(
        &mut self,
        name: &'static str,
        len: usize,
        words: Option<impl FnOnce(u32) -> D>,
    ) -> Option<u32> {
        let (offset, bytes) = self.take(len)?;
        let value = bytes.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte));
        let words = words.map(|words| words(value));
        let words = words.as_ref().map(|words| words as &dyn Display);
        self.show(&Field { offset, bytes, name, value: Value::Number(value), words });
        Some(value)
    }

    pub(super) fn text(&mut self, name: &'static str, len: usize) -> Option<()> {
        let (offset, bytes) = self.take(len)?;
        self.show(&Field { offset, bytes, name, value: Value::Text(bytes), words: None });
        Some(())
    }

    pub(super) fn raw(&mut self, name: &'static str, len: usize) -> Option<()> {
        let (offset, bytes) = self.take(len)?;
        self.show(&Field { offset, bytes, name, value: Value::Bytes(bytes), words: None });
        Some(())
    }

    /// All bytes that are left of the layout.
    pub(super) fn rest(&mut self, name: &'static str) -> Option<()> {
        self.raw(name, self.left())
    }

    pub(super) fn rows(
        &mut self,
        name: &'static str,
        rows: usize,
        columns: &'static [&'static str],
    ) -> Option<()> {
        let (offset, bytes) = self.take(rows * 2 * columns.len())?;
        self.show(&Field { offset, bytes, name, value: Value::Rows { bytes, columns }, words: None });
        Some(())
    }

    /// So many measured values; `make` knows how to read their bytes.
    pub(super) fn ranges(
        &mut self,
        name: &'static str,
        count: usize,
        make: impl FnOnce(&'t [u8]) -> Ranges<'t>,
    ) -> Option<()> {
        let (offset, bytes) = self.take(2 * count)?;
        let ranges = make(bytes);
        self.show(&Field { offset, bytes, name, value: Value::Ranges(ranges), words: Some(&ranges) });
        Some(())
    }

    /// A field without a byte is none.
    fn show(&mut self, field: &Field<'_>) {
        if !field.bytes.is_empty() {
            (self.visit)(field);
        }
    }

    fn take(&mut self, len: usize) -> Option<(usize, &'t [u8])> {
        let bytes = self.bytes.get(self.at..self.at + len).filter(|_| self.at + len <= self.end)?;
        let offset = self.at;
        self.at += len;
        Some((offset, bytes))
    }
}

/// Words that are made when they are wanted.
pub(super) struct Said<F>(F);

/// Words from a closure that writes them.
pub(super) fn said<F: Fn(&mut fmt::Formatter<'_>) -> fmt::Result>(write: F) -> Said<F> {
    Said(write)
}

impl<F: Fn(&mut fmt::Formatter<'_>) -> fmt::Result> Display for Said<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (self.0)(f)
    }
}
