//! Which telegrams an error on the line may have hit. The driver counts errors when bytes reach it, but not which bytes
//! they were. When a telegram has been read, an error may be in it, in another telegram of the same read, or in bytes that
//! arrived since: the start of the next telegram.

/// Whether errors may belong to the bytes read.
#[derive(Debug, Default)]
pub struct LineErrors {
    /// The count moved since the last wait for bytes.
    moved: bool,
    /// It did so in the time before that.
    before: bool,
}

impl LineErrors {
    /// A telegram was read, and the driver counted `errors` since the one before; returns whether they may be in it.
    pub fn note(&mut self, errors: u64) -> bool {
        self.moved |= errors > 0;
        self.moved || self.before
    }

    /// All telegrams of a read were noted, at least one.
    pub fn wait(&mut self) {
        self.before = std::mem::take(&mut self.moved);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_telegram_and_the_next_one() {
        let mut errors = LineErrors::default();
        let mut read = |counts: &[u64]| {
            let marked: Vec<bool> = counts.iter().map(|&count| errors.note(count)).collect();
            errors.wait();
            marked
        };
        assert_eq!(read(&[0]), [false]);
        assert_eq!(read(&[3]), [true]);
        assert_eq!(read(&[0]), [true]);
        assert_eq!(read(&[0]), [false]);
        // Several in one read: the first one brings the news of all.
        assert_eq!(read(&[1, 0, 0]), [true; 3]);
        assert_eq!(read(&[2]), [true]);
        assert_eq!(read(&[0, 0]), [true; 2]);
        assert_eq!(read(&[0]), [false]);
    }
}
