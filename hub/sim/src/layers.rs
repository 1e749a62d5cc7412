//! What makes a measured range different from the true one, layer by layer, each with its own switch. Two layers have
//! no switch: ranges are sent in whole units, and a range beyond the greatest value is sent as a code.

use scanhub_drivers::lms;
use schema::Nanos;

/// Which layers act, and how strongly. A share or a length of 0 switches its layer off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layers {
    /// The most by which all ranges of one device are off, in millimetres; the seed draws it evenly.
    pub bias_mm: f64,
    /// Standard deviation of a range, in millimetres.
    pub sigma_mm: f64,
    /// Share of the readings at edges whose standard deviation is [`TAIL_MM`] instead. In a recording of a sensor that
    /// stood still 316 of 348 beams were never off by 30 mm, and 22 more often than in one scan of a hundred: the tail
    /// belongs to a few beams.
    pub tail: f64,
    /// Whether a beam is as wide as a real one. On two surfaces, it then reports one, the other or a value between. If they
    /// are far apart, it reports one, the other or too weak a signal. Without the layer, a beam is a line without width.
    pub spot: bool,
    /// Share of the beams that report a code although they could report a range.
    pub errors: f64,
    /// Whether dark or oblique surfaces that are far give too weak a signal.
    pub weak: bool,
    /// Whether the sun dazzles.
    pub dazzle: bool,
    /// Whether beams between whole degrees are measured in later mirror turns, as in a real device; else the whole
    /// scan is of one moment.
    pub comb: bool,
}

impl Layers {
    /// Everything off: ranges that are true to the unit.
    pub const NONE: Layers = Layers {
        bias_mm: 0.0,
        sigma_mm: 0.0,
        tail: 0.0,
        spot: false,
        errors: 0.0,
        weak: false,
        dazzle: false,
        comb: false,
    };
}

impl Default for Layers {
    /// All on, as real recordings have them: 6 to 7 mm of deviation per beam, 0.5 % of codes.
    fn default() -> Self {
        Layers {
            bias_mm: 15.0,
            sigma_mm: 5.0,
            tail: 0.1,
            spot: true,
            errors: 0.005,
            weak: true,
            dazzle: true,
            comb: true,
        }
    }
}

/// The dice of one beam, thrown whether a layer needs them or not: a layer that is switched off leaves all others as
/// they were.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BeamRng {
    /// Deviation of the beam's direction, standard normal.
    pub(crate) mirror: f64,
    /// Selects the surface that the scanner reports if a spot is on two of them, 0 to 1.
    pub(crate) surface: f64,
    /// Selects whether the scanner reports a value between them instead, 0 to 1.
    pub(crate) between: f64,
    /// Whether a signal is too weak, 0 to 1.
    pub(crate) weak: f64,
    /// Brightness of a reflector, standard normal.
    pub(crate) bright: f64,
    pub(crate) deviation: f64,
    pub(crate) tail: f64,
    pub(crate) error: f64,
    pub(crate) code: f64,
    pub(crate) dazzle: f64,
}

impl BeamRng {
    /// The next throw.
    pub(crate) fn throw(random: &mut fastrand::Rng) -> BeamRng {
        BeamRng {
            mirror: gaussian(random),
            surface: random.f64(),
            between: random.f64(),
            weak: random.f64(),
            bright: gaussian(random),
            deviation: gaussian(random),
            tail: random.f64(),
            error: random.f64(),
            code: random.f64(),
            dazzle: random.f64(),
        }
    }
}

impl Layers {
    /// What a reading deviates from the truth, in millimetres, the device's bias left aside; more at an `edge`.
    pub(crate) fn deviation_mm(&self, edge: bool, dice: &BeamRng) -> f64 {
        dice.deviation * if edge && dice.tail < self.tail { TAIL_MM } else { self.sigma_mm }
    }

    /// The code that a beam tells although it could tell a range, counted from the greatest value.
    pub(crate) fn error(&self, dice: &BeamRng) -> Option<u16> {
        let of = |code: &&(f64, u16)| dice.code < code.0;
        (dice.error < self.errors).then(|| CODES.iter().find(of).map_or(NO_RETURN, |code| code.1))
    }

    /// Whether a beam loses its echo of so much `signal`: all do below [`LEAST_SIGNAL`] and none above twice that, and
    /// some are lost between two surfaces if the spot is `torn`.
    pub(crate) fn loses(&self, signal: f64, torn: bool, dice: &BeamRng) -> bool {
        let faint = self.weak && dice.weak > signal / LEAST_SIGNAL - 1.0;
        faint || torn && dice.weak < WEAK_AT_EDGES
    }

    /// Whether the sun, which dazzles `share` of the beams that look into it, dazzles this one.
    pub(crate) fn dazzles(&self, share: f64, dice: &BeamRng) -> bool {
        self.dazzle && dice.dazzle < share
    }

    /// Start of the mirror turn `turn` of `turns`, of a scan that ended at `end_ns`.
    pub(crate) fn turn_ns(&self, turn: u64, turns: u64, end_ns: Nanos) -> Nanos {
        let before_end = if self.comb { turns - turn } else { 1 };
        end_ns.saturating_sub(before_end * lms::variant::MIRROR_TURN)
    }
}

#[cfg(test)]
impl BeamRng {
    /// Nothing off anywhere.
    pub(crate) const CENTRE: BeamRng = BeamRng {
        mirror: 0.0,
        surface: 0.5,
        between: 0.5,
        weak: 0.5,
        bright: 0.0,
        deviation: 0.0,
        tail: 0.5,
        error: 0.5,
        code: 0.5,
        dazzle: 0.5,
    };
}

/// Standard normal, by the sum of twelve.
fn gaussian(random: &mut fastrand::Rng) -> f64 {
    (0..12).map(|_| random.f64()).sum::<f64>() - 6.0
}

/// Standard deviation of the readings in the tail, in millimetres: most of them are further off than the 30 mm that
/// methods take for a change.
pub const TAIL_MM: f64 = 60.0;

/// The least signal that comes back as a range, beside a white surface at 1 m: 10 % of white at 18 m.
const LEAST_SIGNAL: f64 = 0.0003;
/// Share of the beams between two surfaces far apart whose signal is too weak.
const WEAK_AT_EDGES: f64 = 0.15;

// Codes are counted down from the greatest value (Telegram listing 10.8).
pub(crate) const NO_RETURN: u16 = 0;
pub(crate) const DAZZLE: u16 = 1;
pub(crate) const TOO_WEAK: u16 = 4;
const OVERFLOW: u16 = 2;
/// Codes of beams that could have told a range, by their summed shares: those of a recording of a real LMS 200, of
/// beams that told a range in at least 16 of 20 scans.
const CODES: [(f64, u16); 3] = [(0.57, NO_RETURN), (0.94, TOO_WEAK), (1.0, OVERFLOW)];
