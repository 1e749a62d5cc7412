//! What a method makes of a thing that is put down and of one that is taken away, in the room of Fig. 8: how much of the
//! first one is foreground still after N scans, and how much of the second one is background still after N and 2N.

use schema::Scan;
use sim::labeled_scan::Met;

use super::method::Method;
use super::play::Frame;

/// Scans until a surface is background: the default at half degrees.
const N: usize = 375;

/// Beams of both boxes over some runs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Boxes {
    /// Beams that meet box 1, N scans after it was put down, and those of them that are foreground.
    new: Share,
    /// Beams that met box 2, N and 2N scans after it was taken away, and those that would not be foreground if it stood
    /// there again.
    gone: [Share; 2],
}

/// So many of so many.
#[derive(Clone, Copy, Debug, Default)]
struct Share {
    of: u64,
    are: u64,
}

impl Share {
    fn count(&mut self, is: bool) {
        self.of += 1;
        self.are += u64::from(is);
    }

    fn percent(&self) -> f64 {
        100.0 * self.are as f64 / self.of as f64
    }
}

impl Boxes {
    /// Adds a run of `frames`; `make` makes the method anew.
    pub(crate) fn add(&mut self, make: impl Fn() -> Box<dyn Method>, frames: &[Frame]) {
        let first = |is: fn(&Met) -> bool| {
            frames.iter().position(|frame| frame.met.iter().any(is)).expect("boxes come and go in this room")
        };
        let at = first(is_new) + N;
        let told = told(&mut *make(), &frames[..at], &frames[at].scan);
        for (i, _) in frames[at].met.iter().enumerate().filter(|(_, met)| is_new(met)) {
            self.new.count(told[i]);
        }

        let taken = first(is_bare);
        let stood = &frames[taken - 1];
        for (gone, at) in self.gone.iter_mut().zip([taken + N, taken + 2 * N]) {
            let now = &frames[at];
            // At its edges a beam may have told what stood behind it.
            let inside = |i: &usize| now.met[i - 1..=i + 1].iter().all(is_bare);
            let beams: Vec<usize> = (1..stood.met.len() - 1).filter(inside).collect();
            let mut scan = now.scan.clone();
            let span = beams[0]..=beams[beams.len() - 1];
            scan.arrays().ranges[span.clone()].copy_from_slice(&stood.scan.ranges()[span]);
            let told = self::told(&mut *make(), &frames[..at], &scan);
            let met_box = beams.into_iter().filter(|&i| is_still(&stood.met[i]));
            met_box.for_each(|i| gone.count(!told[i]));
        }
    }

    /// Percent of a box that are foreground N scans after it was put down; of one that are background N and 2N scans
    /// after it was taken away.
    pub(crate) fn percents(&self) -> [f64; 3] {
        [self.new.percent(), self.gone[0].percent(), self.gone[1].percent()]
    }
}

fn is_new(met: &Met) -> bool {
    matches!(met, Met::Box { .. })
}

/// Here stood what was taken away.
fn is_bare(met: &Met) -> bool {
    matches!(met, Met::Static { since_ns: 1.. })
}

fn is_still(met: &Met) -> bool {
    matches!(met, Met::Static { since_ns: 0 })
}

/// What `method` tells of `scan` after `before`.
fn told(method: &mut dyn Method, before: &[Frame], scan: &Scan) -> Vec<bool> {
    let mut foreground = vec![false; scan.beams()];
    before.iter().for_each(|frame| method.update(&frame.scan, &mut foreground));
    method.update(scan, &mut foreground);
    foreground
}
