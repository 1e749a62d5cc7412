//! Which lights are on for a verdict and a number of marks, as LEDs and as a line of text.

use std::io::{self, Write};

use scanhub_schema::Verdict;

/// A light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Light {
    /// Nothing is inside any circle.
    Green,
    /// Something is inside, but not inside the smallest circle.
    Yellow,
    /// Something is inside the smallest circle, or it is not known.
    Red,
    /// A reflector mark is seen.
    Mark,
}

impl Light {
    /// All lights, in the order of all output.
    pub(crate) const ALL: [Light; 4] = [Light::Green, Light::Yellow, Light::Red, Light::Mark];

    /// The light's name in all output and on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Light::Green => "green",
            Light::Yellow => "yellow",
            Light::Red => "red",
            Light::Mark => "mark",
        }
    }

    /// Its colour on a terminal (ECMA-48, SGR).
    fn colour(self) -> u8 {
        match self {
            Light::Green => 32,
            Light::Yellow => 33,
            Light::Red => 31,
            Light::Mark => 36,
        }
    }
}

/// What is known, and so what is lit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Lamps {
    /// What to make of the circles.
    pub(crate) verdict: Verdict,
    /// Marks in the last scan; nothing if that is not known.
    pub(crate) marks: Option<usize>,
    /// Of several sensors the one whose verdict it is.
    pub(crate) worst: Option<String>,
}

impl Lamps {
    /// Nobody watches: the stop light.
    pub(crate) const UNKNOWN: Lamps = Lamps { verdict: Verdict::Unknown, marks: None, worst: None };

    /// Whether `light` is on. What is not known is to be taken as stop.
    pub(crate) fn lit(&self, light: Light) -> bool {
        match light {
            Light::Green => self.verdict == Verdict::Clear,
            Light::Yellow => self.verdict == Verdict::Slow,
            Light::Red => matches!(self.verdict, Verdict::Stop | Verdict::Unknown),
            Light::Mark => self.marks.is_some_and(|marks| marks > 0),
        }
    }

    /// The lights of `sensor` as a line, with what may be the `reason`: readable with colours and without.
    pub(crate) fn line(
        &self,
        line: &mut Vec<u8>,
        sensor: &str,
        reason: Option<&str>,
        colours: bool,
    ) -> io::Result<()> {
        write!(line, "{sensor}")?;
        for light in Light::ALL {
            let (name, lit) = (light.name(), self.lit(light));
            let sign = if lit { '●' } else { '○' };
            match (lit, colours) {
                (true, true) => write!(line, "  \x1b[1;{}m{sign} {name}\x1b[0m", light.colour())?,
                _ => write!(line, "  {sign} {name}")?,
            }
        }
        write!(line, "  {}", self.verdict.name())?;
        if let Some(worst) = &self.worst {
            write!(line, " {worst}")?;
        }
        match self.marks {
            Some(1) => write!(line, ", 1 mark")?,
            Some(marks) => write!(line, ", {marks} marks")?,
            None => {}
        }
        match reason {
            Some(reason) => write!(line, ", {reason}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lamps(verdict: Verdict, marks: Option<usize>) -> Lamps {
        Lamps { verdict, marks, worst: None }
    }

    #[test]
    fn one_of_three_lights_is_on_and_the_fourth_by_itself() {
        for (verdict, light) in [
            (Verdict::Clear, Light::Green),
            (Verdict::Slow, Light::Yellow),
            (Verdict::Stop, Light::Red),
            (Verdict::Unknown, Light::Red),
        ] {
            for (marks, is_lit) in [(None, false), (Some(0), false), (Some(1), true), (Some(12), true)] {
                let lamps = lamps(verdict, marks);
                for one in [Light::Green, Light::Yellow, Light::Red] {
                    assert_eq!(lamps.lit(one), one == light, "{lamps:?}");
                }
                assert_eq!(lamps.lit(Light::Mark), is_lit);
            }
        }
        assert!(Lamps::UNKNOWN.lit(Light::Red));
    }

    #[test]
    fn lines() {
        let text = |lamps: &Lamps, colours| {
            let mut line = Vec::new();
            lamps.line(&mut line, "front", None, colours).unwrap();
            String::from_utf8(line).unwrap()
        };
        let stop = Lamps { worst: Some("rear".into()), ..lamps(Verdict::Stop, None) };
        assert_eq!(text(&stop, false), "front  ○ green  ○ yellow  ● red  ○ mark  stop rear");
        let clear = lamps(Verdict::Clear, Some(1));
        assert_eq!(text(&clear, false), "front  ● green  ○ yellow  ○ red  ● mark  clear, 1 mark");
        assert_eq!(
            text(&clear, true),
            "front  \x1b[1;32m● green\x1b[0m  ○ yellow  ○ red  \x1b[1;36m● mark\x1b[0m  clear, 1 mark"
        );
        assert!(text(&lamps(Verdict::Slow, Some(0)), false).ends_with("  slow, 0 marks"));
        let mut line = Vec::new();
        stop.line(&mut line, "robot", Some("41 % lost on the line"), false).unwrap();
        assert!(line.ends_with(b"  stop rear, 41 % lost on the line"));
    }
}
