//! The bytes of a framer whose fate is open, and the account of all of them: in [`Tally`] always
//! `read == in_packets + discarded + buffered`. Refuses to know what the bytes say.

/// What became of the bytes; every field only grows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Bytes committed.
    pub read: u64,
    /// Bytes of packets that were handed out.
    pub in_packets: u64,
    /// Bytes that were in nothing.
    pub discarded: u64,
    /// Packets that were handed out.
    pub packets: u64,
    /// Headers among the discarded bytes of which the checksum was wrong.
    pub rejected_checksum: u64,
}

/// Bytes whose fate is open, `N` at most.
#[derive(Clone, Debug)]
pub struct Buffer<const N: usize> {
    bytes: [u8; N],
    /// `bytes[start..end]` are the open ones.
    start: usize,
    end: usize,
    tally: Tally,
}

impl<const N: usize> Default for Buffer<N> {
    fn default() -> Self {
        Buffer { bytes: [0; N], start: 0, end: 0, tally: Tally::default() }
    }
}

impl<const N: usize> Buffer<N> {
    /// Room for the next bytes: write into its beginning, then [`Buffer::commit`]. Ends what [`Buffer::taken`] shows.
    pub fn spare(&mut self) -> &mut [u8] {
        self.bytes.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        &mut self.bytes[self.end..]
    }

    /// The first `len` bytes of [`Buffer::spare`] are valid now.
    ///
    /// # Panics
    ///
    /// If there was no room for so many.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= N, "more bytes committed than there was room");
        self.tally.read += len as u64;
    }

    /// The open bytes.
    pub fn open(&self) -> &[u8] {
        &self.bytes[self.start..self.end]
    }

    /// Number of the first open byte among all bytes committed, from 0.
    pub fn offset(&self) -> u64 {
        self.tally.read - (self.end - self.start) as u64
    }

    /// The first `len` open bytes are `packets` packets. Where they are, for [`Buffer::taken`].
    pub fn take(&mut self, len: usize, packets: usize) -> usize {
        let at = self.start;
        self.start += len;
        self.tally.packets += packets as u64;
        self.tally.in_packets += len as u64;
        at
    }

    /// The last `len` bytes that were taken, which are `packets` packets, are open again.
    pub fn give_back(&mut self, len: usize, packets: usize) {
        self.start -= len;
        self.tally.packets -= packets as u64;
        self.tally.in_packets -= len as u64;
    }

    /// `len` bytes that [`Buffer::take`] took `at` this place.
    pub fn taken(&self, at: usize, len: usize) -> &[u8] {
        &self.bytes[at..at + len]
    }

    /// The first `len` open bytes are in nothing.
    pub fn discard(&mut self, len: usize) {
        self.start += len;
        self.tally.discarded += len as u64;
    }

    /// Gives up all open bytes, for example because the line's rate changes.
    pub fn clear(&mut self) {
        self.discard(self.end - self.start);
    }

    /// Of what was discarded, one began like a packet, and its checksum was wrong.
    pub fn reject_checksum(&mut self) {
        self.tally.rejected_checksum += 1;
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }
}
