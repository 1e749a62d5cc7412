//! A consumer of scans as a process of its own, and what its lines tell: what it missed, what was incomplete, and how even
//! the stamps are.

use std::io::Write;

use schema::Scan;

use crate::support::child::Line;
use crate::support::{Outcome, consumer};

/// Follows the scans of `sensor` for ever; prints each: `scan STAMP_NS MISSED INCOMPLETE`.
pub(crate) fn scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = consumer::subscribe::<Scan>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(scan) = scans.next()? else { continue };
        let incomplete = u8::from(scan.is_incomplete());
        writeln!(out, "scan {} {} {incomplete}", scan.header().stamp_first_ns, scan.missed)?;
    }
}

/// What a consumer printed.
#[derive(Default)]
pub(crate) struct Scans {
    stamps_ns: Vec<u64>,
    pub(crate) missed: u64,
    pub(crate) incomplete: u64,
}

impl Scans {
    pub(crate) fn of(lines: &[Line]) -> Outcome<Scans> {
        let mut scans = Scans::default();
        for line in lines {
            scans.stamps_ns.push(line.number(1)?);
            scans.missed += line.number(2)?;
            scans.incomplete += line.number(3)?;
        }
        Ok(scans)
    }

    /// By how much two scans in a row lie farther from a whole number of turns than they should, at most.
    pub(crate) fn unevenness_ms(&self) -> f64 {
        let mut spans: Vec<f64> =
            self.stamps_ns.windows(2).map(|pair| pair[1].abs_diff(pair[0]) as f64 / 1e6).collect();
        let mut sorted = spans.clone();
        sorted.sort_by(f64::total_cmp);
        let Some(&turn) = sorted.get(sorted.len() / 2) else { return f64::NAN };
        spans.iter_mut().for_each(|span| *span = (*span - turn * (*span / turn).round()).abs());
        spans.into_iter().fold(0.0, f64::max)
    }
}
