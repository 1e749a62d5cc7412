//! Consumers of scans and of packets as processes of their own, and what their lines tell: what was missed and what was
//! incomplete, how even the stamps of scans are, and how right those of packets.

use std::collections::HashMap;
use std::io::Write;

use schema::Scan;

use crate::support::child::Line;
use crate::support::{Outcome, consumer, truth};

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

/// Follows the packets of `sensor`, of `len` bytes each, for ever; prints of each sample: `packets STAMP_NS HASH`, when the last
/// packet was there, and which one it is.
pub(crate) fn packets(domain: &str, sensor: &str, len: usize) -> Outcome<()> {
    let mut samples = consumer::subscribe::<[u8]>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(sample) = samples.next()? else { continue };
        // Answers have other lengths.
        if let Some(last) = sample.rchunks_exact(len).next().filter(|_| sample.len() % len == 0) {
            writeln!(out, "packets {} {}", sample.header().stamp_last_ns, truth::hash(last))?;
        }
    }
}

/// Of the stamps that a consumer of packets printed, each of which was `due` at one of those times: by how much they are off at
/// most, in ms, and how many by more than `limit_ms`.
pub(crate) fn off_ms(lines: &[Line], due: &HashMap<&str, Vec<u64>>, limit_ms: f64) -> Outcome<(f64, usize)> {
    let mut off_ms = Vec::new();
    for line in lines {
        let stamp = line.number(1)?;
        let due = line.words().last().and_then(|hash| due.get(hash));
        let off = due.and_then(|due| due.iter().map(|due| due.abs_diff(stamp)).min());
        off_ms.extend(off.map(|ns| ns as f64 / 1e6));
    }
    let worst = off_ms.iter().copied().reduce(f64::max).ok_or("no packet is known to the simulator")?;
    Ok((worst, off_ms.iter().filter(|off| **off > limit_ms).count()))
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
