//! What the line of one sensor lost while a verb ran, from the counters of its statuses. The counters start at 0 when
//! the hub restarts. Refuses to know where statuses come from.

use scanhub_schema::{Counter, Counters};

/// The account of one line in one run.
#[derive(Clone, Debug, Default)]
pub(crate) struct Line {
    /// Life of the hub, its counters when the run met it, and the last ones.
    life: Option<(u64, Counters, Counters)>,
    /// What lives before that one came to.
    past: Sums,
}

/// What the line took away in a run; nothing where that is not known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Loss {
    /// Share of the bytes that were in nothing, 0 to 1.
    pub(crate) damaged: Option<f64>,
    /// Scans that must have been sent and did not arrive.
    pub(crate) lost_on_line: Option<u64>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    read: u64,
    damaged: u64,
    lost: u64,
    is_known: bool,
}

impl Line {
    /// A status with `counters` came, of the hub's life `boot`.
    pub(crate) fn note(&mut self, boot: u64, counters: &Counters) {
        match &mut self.life {
            Some((life, _, last)) if *life == boot => *last = *counters,
            Some(_) => {
                self.past = self.sums();
                // A hub that came while the run went on: all that it counted is of the run.
                self.life = Some((boot, Counters::default(), *counters));
            }
            None => self.life = Some((boot, *counters, *counters)),
        }
    }

    /// What it took away since the first status.
    pub(crate) fn loss(&self) -> Loss {
        let Sums { read, damaged, lost, is_known } = self.sums();
        let damaged = (read > 0).then(|| (damaged as f64 / read as f64).min(1.0));
        Loss { damaged, lost_on_line: is_known.then_some(lost) }
    }

    fn sums(&self) -> Sums {
        let Some((_, first, last)) = &self.life else { return self.past };
        let grown = |counter| last[counter].saturating_sub(first[counter]);
        Sums {
            read: self.past.read + grown(Counter::BytesRead),
            damaged: self.past.damaged + grown(Counter::BytesDamaged),
            lost: self.past.lost + grown(Counter::LostOnLine),
            is_known: self.past.is_known || last[Counter::DueOnLine] > 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counters(read: u64, damaged: u64, due: u64, lost: u64) -> Counters {
        let mut counters = Counters::default();
        counters[Counter::BytesRead] = read;
        counters[Counter::BytesDamaged] = damaged;
        counters[Counter::DueOnLine] = due;
        counters[Counter::LostOnLine] = lost;
        counters
    }

    #[test]
    fn a_run_has_what_grew_while_it_went_on() {
        let mut line = Line::default();
        assert_eq!(line.loss(), Loss::default());
        line.note(1, &counters(1000, 500, 0, 0));
        assert_eq!(line.loss(), Loss { damaged: None, lost_on_line: None });
        line.note(1, &counters(2000, 600, 10, 3));
        assert_eq!(line.loss(), Loss { damaged: Some(0.1), lost_on_line: Some(3) });
        // Another life of the hub counts from 0.
        line.note(2, &counters(1000, 100, 5, 2));
        assert_eq!(line.loss(), Loss { damaged: Some(0.1), lost_on_line: Some(5) });
        line.note(2, &counters(3000, 700, 50, 20));
        assert_eq!(line.loss(), Loss { damaged: Some(0.2), lost_on_line: Some(23) });
    }
}
