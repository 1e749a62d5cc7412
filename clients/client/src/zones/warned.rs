//! Zones with the early warnings of their sensor: a warning makes the verdict worse until the zones of the same scan are there,
//! or until it is withdrawn. It never makes it better. Refuses to know where samples come from.

use schema::{Early, Header, Verdict, Zones};

/// What is known of one sensor's zones, and what was said of the scan after that.
#[derive(Clone, Debug)]
pub(super) struct Warned {
    known: Zones,
    /// Life of the hub, and the number of the last scan whose zones are known.
    scan: Option<(u64, u64)>,
    /// The warning that stands, and whose it is, as above.
    warning: Option<((u64, u64), Early)>,
}

impl Warned {
    /// Nothing is known.
    pub(super) fn new() -> Warned {
        Warned { known: Zones::unknown(), scan: None, warning: None }
    }

    /// Takes the zones of a scan, with the header of the sample, or a silence, which has none; returns them as a warning of a
    /// later scan makes them.
    pub(super) fn hear(&mut self, zones: &Zones, header: Option<&Header>) -> Zones {
        self.known = *zones;
        let Some(header) = header else {
            self.warning = None;
            return *zones;
        };
        self.scan = Some((header.boot, header.seq));
        self.warning = self.warning.filter(|((boot, seq), _)| *boot == header.boot && *seq > header.seq);
        self.warning.map_or(*zones, |(_, early)| self.with(&early))
    }

    /// The zones as `early` makes them; nothing if it is of a scan whose zones are known.
    pub(super) fn warn(&mut self, early: &Early, header: &Header) -> Option<Zones> {
        if self.scan.is_some_and(|(boot, seq)| boot == header.boot && header.seq <= seq) {
            return None;
        }
        if early.is_withdrawn() {
            self.warning = None;
            return Some(self.known);
        }
        self.warning = Some(((header.boot, header.seq), *early));
        Some(self.with(early))
    }

    fn with(&self, early: &Early) -> Zones {
        let mut zones = Zones { verdict: self.known.verdict().worse(warning(early)) as u8, ..self.known };
        if self.known.nearest().is_none_or(|(_, known_mm)| early.distance_mm < known_mm) {
            (zones.nearest_beam, zones.nearest_mm) = (early.beam, early.distance_mm);
        }
        zones
    }
}

/// What a warning says; one that this program does not know is none.
fn warning(early: &Early) -> Verdict {
    match early.verdict() {
        warning @ (Verdict::Slow | Verdict::Stop) => warning,
        Verdict::Clear | Verdict::Unknown => Verdict::Clear,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn zones(verdict: Verdict) -> Zones {
        Zones { verdict: verdict as u8, ..Zones::unknown() }
    }

    fn of_scan(seq: u64) -> Header {
        Header { seq, boot: 1, ..Header::default() }
    }

    const STOP: Early =
        Early { verdict: 2, flags: 0, beam: 40, distance_mm: 500, bytes_seen: 240, beams_seen: 116 };

    #[test]
    fn a_warning_holds_until_its_scan_is_known_or_it_is_withdrawn() {
        let mut warned = Warned::new();
        warned.hear(&zones(Verdict::Clear), Some(&of_scan(7)));
        assert_eq!(warned.warn(&STOP, &of_scan(7)), None, "the scan has come already");
        let stop = warned.warn(&STOP, &of_scan(8)).expect("a warning");
        assert_eq!((stop.verdict(), stop.nearest()), (Verdict::Stop, Some((40, 500))));
        let withdrawn = Early { flags: Early::WITHDRAWN, ..STOP };
        assert_eq!(warned.warn(&withdrawn, &of_scan(8)), Some(zones(Verdict::Clear)));
        warned.hear(&zones(Verdict::Slow), Some(&of_scan(8)));
        assert_eq!(warned.warn(&withdrawn, &of_scan(8)), None);
        // Zones of a scan before it are overtaken by a warning.
        assert!(warned.warn(&STOP, &of_scan(10)).is_some());
        let overtaken = warned.hear(&zones(Verdict::Clear), Some(&of_scan(9)));
        assert_eq!(overtaken.verdict(), Verdict::Stop);
        assert_eq!(warned.hear(&zones(Verdict::Clear), Some(&of_scan(10))), zones(Verdict::Clear));
        assert!(warned.warn(&STOP, &of_scan(12)).is_some());
        assert_eq!(warned.hear(&Zones::unknown(), None), Zones::unknown(), "a silence");
        assert_eq!(warned.hear(&zones(Verdict::Clear), Some(&of_scan(11))), zones(Verdict::Clear));
        let next_hub = Header { boot: 2, ..of_scan(0) };
        assert_eq!(warned.warn(&STOP, &next_hub).map(|zones| zones.verdict()), Some(Verdict::Stop));
    }

    #[test]
    fn a_warning_never_makes_it_better() {
        let mut warned = Warned::new();
        let slow = Early { verdict: Verdict::Slow as u8, ..STOP };
        for verdict in Verdict::ALL {
            warned.hear(&zones(verdict), None);
            for early in [slow, STOP, Early { verdict: 9, ..STOP }, Early { verdict: 0, ..STOP }] {
                let now = warned.warn(&early, &of_scan(1)).expect("nothing is known of the scan").verdict();
                assert_eq!(now.worse(verdict), now, "{verdict:?} and {early:?}");
            }
        }
    }
}
