//! The scanners of Slamtec that are simulated, as plain tables: line, motor, and the modes that each offers. Whole
//! microseconds, names and answer types of the A1 are those of a real A1M8 with firmware 1.29; the others' are what their
//! data sheets and the logs of the vendor's driver say, and nobody has measured them here.

/// A scanner of the family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// RPLIDAR A1M8.
    A1,
    /// RPLIDAR A2M8.
    A2m8,
    /// RPLIDAR A2M12.
    A2m12,
    /// RPLIDAR A3M1.
    A3,
    /// RPLIDAR S1.
    S1,
    /// RPLIDAR S2.
    S2,
    /// RPLIDAR S3.
    S3,
    /// RPLIDAR C1.
    C1,
}

/// How a mode's points travel: the type in its descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// 0x81: one point in 5 bytes.
    Standard,
    /// 0x82: 32 points in 84 bytes, angles corrected one by one.
    Express,
    /// 0x84: 96 points in 132 bytes, two of three ranges predicted.
    Ultra,
    /// 0x85: 40 points in 84 bytes.
    Dense,
    /// 0x86: 64 points in 170 bytes.
    UltraDense,
}

/// A way of measuring that a host can ask for by its number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// As the scanner calls it.
    pub name: &'static str,
    /// From one point to the next, in microseconds, as the scanner says; a real A1 takes 0.7 % longer.
    pub sample_us: f64,
    /// How its points travel.
    pub form: Form,
    /// The farthest that it says it measures, in metres.
    pub reach_m: f64,
}

/// What makes the motor turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motor {
    /// The line DTR, which a pty has not: it turns as long as there is power.
    Dtr,
    /// An accessory board that is told a duty cycle.
    Pwm,
    /// The scanner itself, which is told revolutions a minute.
    Rpm,
}

impl Form {
    /// The type in the descriptor.
    pub fn answer(self) -> u8 {
        match self {
            Form::Standard => 0x81,
            Form::Express => 0x82,
            Form::Ultra => 0x84,
            Form::Dense => 0x85,
            Form::UltraDense => 0x86,
        }
    }

    /// Bytes of a packet.
    pub fn packet_len(self) -> usize {
        match self {
            Form::Standard => 5,
            Form::Express | Form::Dense => 84,
            Form::Ultra => 132,
            Form::UltraDense => 170,
        }
    }

    /// Points in a packet.
    pub fn points(self) -> usize {
        match self {
            Form::Standard => 1,
            Form::Express => 32,
            Form::Ultra => 96,
            Form::Dense => 40,
            Form::UltraDense => 64,
        }
    }
}

impl Model {
    /// All of them.
    pub const ALL: [Model; 8] =
        [Model::A1, Model::A2m8, Model::A2m12, Model::A3, Model::S1, Model::S2, Model::S3, Model::C1];

    /// As options call it.
    pub fn name(self) -> &'static str {
        match self {
            Model::A1 => "a1",
            Model::A2m8 => "a2m8",
            Model::A2m12 => "a2m12",
            Model::A3 => "a3",
            Model::S1 => "s1",
            Model::S2 => "s2",
            Model::S3 => "s3",
            Model::C1 => "c1",
        }
    }

    /// The byte that names it in its info.
    pub fn id(self) -> u8 {
        match self {
            Model::A1 => 0x18,
            Model::A2m8 => 0x28,
            Model::A2m12 => 0x2C,
            Model::A3 => 0x31,
            Model::S1 => 0x61,
            Model::S2 => 0x71,
            Model::S3 => 0x81,
            Model::C1 => 0x41,
        }
    }

    /// Rate of its line in bits per second.
    pub fn baud(self) -> u32 {
        match self {
            Model::A1 | Model::A2m8 => 115_200,
            Model::A2m12 | Model::A3 | Model::S1 => 256_000,
            Model::S2 | Model::S3 => 1_000_000,
            Model::C1 => 460_800,
        }
    }

    /// The modes, each at its number.
    pub fn modes(self) -> &'static [Mode] {
        match self {
            Model::A1 | Model::A2m8 => &MODES_8K,
            Model::A2m12 => &MODES_A2M12,
            Model::A3 => &MODES_A3,
            Model::S1 => &MODES_S1,
            Model::S2 => &MODES_S3[..2],
            Model::S3 => &MODES_S3,
            Model::C1 => &MODES_C1,
        }
    }

    /// Number of the mode that it recommends.
    pub fn typical(self) -> usize {
        match self {
            Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3 => 3,
            Model::S1 => 2,
            Model::S2 | Model::S3 => 1,
            Model::C1 => 0,
        }
    }

    /// Turns in a second out of its box. A real A1 sent 1,954 points a second and 264 to 267 of them in a turn.
    pub fn turns_per_second(self) -> f64 {
        if self == Model::A1 { 7.36 } else { 10.0 }
    }

    /// Between which ranges it measures, in millimetres, by its data sheet.
    pub(crate) fn reach_mm(self) -> std::ops::RangeInclusive<f64> {
        match self {
            Model::A1 => 150.0..=12_000.0,
            Model::A2m8 | Model::A2m12 => 200.0..=12_000.0,
            Model::A3 => 200.0..=25_000.0,
            Model::S1 => 100.0..=40_000.0,
            Model::S2 => 50.0..=30_000.0,
            Model::S3 => 50.0..=40_000.0,
            Model::C1 => 50.0..=12_000.0,
        }
    }

    /// Whether it measures by a laser beside its lens: then the angle of a point depends on its range, and weak surfaces
    /// are lost early. The others measure the light's time of flight.
    pub(crate) fn triangulates(self) -> bool {
        matches!(self, Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)
    }

    pub(crate) fn motor(self) -> Motor {
        match self {
            Model::A1 | Model::C1 => Motor::Dtr,
            Model::A2m8 | Model::A2m12 | Model::A3 => Motor::Pwm,
            Model::S1 | Model::S2 | Model::S3 => Motor::Rpm,
        }
    }

    /// Firmware as (major, minor), and the hardware's number; the vendor's driver takes an A2 or A3 of hardware 6 for one
    /// of 256,000 baud.
    pub(crate) fn versions(self) -> ([u8; 2], u8) {
        match self {
            Model::A1 => ([1, 29], 5),
            Model::A2m8 => ([1, 29], 5),
            Model::A2m12 | Model::A3 => ([1, 29], 6),
            Model::S1 | Model::S2 | Model::S3 => ([1, 2], 18),
            Model::C1 => ([1, 1], 18),
        }
    }

    /// How much longer its microseconds are than those of the host: an A1 said 508 us and sent 1,954 points a second.
    pub(crate) fn slowness(self) -> f64 {
        if self == Model::A1 { 1.0 / (508e-6 * 1_954.0) } else { 1.0 }
    }
}

const fn mode(name: &'static str, sample_us: f64, form: Form, reach_m: f64) -> Mode {
    Mode { name, sample_us, form, reach_m }
}

/// Those of a laser beside a lens: a point of the fastest ones takes `us` microseconds, one of Stability `stable_us`.
const fn modes(us: f64, stable_us: f64, reach_m: f64, fast_reach_m: f64) -> [Mode; 5] {
    [
        mode("Standard", 4.0 * us, Form::Standard, reach_m),
        mode("Express", 2.0 * us, Form::Express, reach_m),
        mode("Boost", us, Form::Ultra, fast_reach_m),
        mode("Sensitivity", us, Form::Ultra, fast_reach_m),
        mode("Stability", stable_us, Form::Ultra, fast_reach_m),
    ]
}

const MODES_8K: [Mode; 5] = modes(127.0, 201.0, 12.0, 12.0);
const MODES_A2M12: [Mode; 5] = modes(63.0, 100.0, 12.0, 12.0);
const MODES_A3: [Mode; 5] = modes(63.0, 100.0, 16.0, 25.0);
/// Its standard mode is as fast as the line is.
const MODES_S1: [Mode; 3] = [
    mode("Standard", 217.0, Form::Standard, 16.0),
    mode("Express", 108.5, Form::Express, 16.0),
    mode("DenseBoost", 108.5, Form::Dense, 40.0),
];
const MODES_S3: [Mode; 3] = [
    mode("Standard", 62.5, Form::Standard, 16.0),
    mode("DenseBoost", 31.25, Form::Dense, 40.0),
    mode("UltraDense", 31.25, Form::UltraDense, 40.0),
];
const MODES_C1: [Mode; 2] =
    [mode("Standard", 200.0, Form::Standard, 16.0), mode("DenseBoost", 200.0, Form::Dense, 16.0)];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mode_fits_its_line_and_leaves_a_twentieth_of_it() {
        for model in Model::ALL {
            assert!(model.typical() < model.modes().len());
            for mode in model.modes() {
                let packets = 1e6 / (mode.sample_us * model.slowness() * mode.form.points() as f64);
                let load = packets * mode.form.packet_len() as f64 * 10.0 / f64::from(model.baud());
                assert!(load < 0.95, "{model:?} {}: {load}", mode.name);
            }
        }
    }
}
