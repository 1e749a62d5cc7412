//! Zones with the early warnings of their sensor: a warning makes the verdict worse until the zones of the same scan are there,
//! or until it is withdrawn. It never makes it better. Refuses to know where samples come from.

use scanhub_schema::{Early, Header, Verdict, Zones};

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

    fn zones(verdict: u8) -> Zones {
        Zones { verdict, ..Zones::unknown() }
    }

    const STOP: Early =
        Early { verdict: 2, flags: 0, beam: 40, distance_mm: 500, bytes_seen: 240, beams_seen: 116 };

    /// What the package for Python is tested with, too.
    const VECTORS: &str = include_str!("../../../../tests/vectors/early.txt");

    fn header(scan: &str) -> Header {
        let (boot, seq) = scan.split_once(':').expect("LIFE:NUMBER");
        Header {
            boot: boot.parse().expect("a life"),
            seq: seq.parse().expect("a number"),
            ..Header::default()
        }
    }

    fn said(zones: &Zones) -> String {
        let nearest = zones.nearest().map_or("-".to_owned(), |(_, mm)| mm.to_string());
        format!("{} {nearest}", zones.verdict() as u8)
    }

    #[test]
    fn what_is_known_is_what_the_vectors_say() {
        let (mut warned, mut steps) = (Warned::new(), 0);
        let lines = VECTORS.lines().zip(1..).filter(|(line, _)| !line.is_empty() && !line.starts_with('#'));
        for (line, number) in lines {
            let (step, known) = line.split_once(" => ").unwrap_or((line, ""));
            let words: Vec<&str> = step.split(' ').collect();
            let verdict = |word: &str| word.parse().expect("a verdict");
            let told = match words[..] {
                ["begin"] => {
                    warned = Warned::new();
                    continue;
                }
                ["zones", scan, word, nearest] => {
                    let mut zones = zones(verdict(word));
                    if let Ok(mm) = nearest.parse() {
                        (zones.nearest_beam, zones.nearest_mm) = (7, mm);
                    }
                    Some(warned.hear(&zones, Some(&header(scan))))
                }
                ["silence"] => Some(warned.hear(&Zones::unknown(), None)),
                ["early", scan, word, mm] => {
                    let distance_mm = mm.parse().expect("a distance");
                    warned.warn(&Early { verdict: verdict(word), distance_mm, ..STOP }, &header(scan))
                }
                ["withdrawn", scan] => warned.warn(&Early { flags: Early::WITHDRAWN, ..STOP }, &header(scan)),
                _ => panic!("line {number}: {line}"),
            };
            assert_eq!(told.as_ref().map_or("old".to_owned(), said), known, "line {number}: {line}");
            steps += 1;
        }
        assert!(steps > 40, "{steps}");
    }

    #[test]
    fn the_nearest_beam_is_that_of_the_nearest_point() {
        let mut warned = Warned::new();
        warned.hear(&zones(0), Some(&header("1:7")));
        let stop = warned.warn(&STOP, &header("1:8")).expect("a warning");
        assert_eq!((stop.verdict(), stop.nearest()), (Verdict::Stop, Some((40, 500))));
        let near = Zones { nearest_beam: 3, nearest_mm: 400, ..zones(0) };
        assert_eq!(warned.hear(&near, Some(&header("1:7"))).nearest(), Some((3, 400)));
    }

    #[test]
    fn a_warning_never_makes_it_better() {
        let mut warned = Warned::new();
        let slow = Early { verdict: Verdict::Slow as u8, ..STOP };
        for verdict in Verdict::ALL {
            warned.hear(&zones(verdict as u8), None);
            for early in [slow, STOP, Early { verdict: 9, ..STOP }, Early { verdict: 0, ..STOP }] {
                let now =
                    warned.warn(&early, &header("1:1")).expect("nothing is known of the scan").verdict();
                assert_eq!(now.worse(verdict), now, "{verdict:?} and {early:?}");
            }
        }
    }
}
