//! What a world begins with, as its seed has it: the sensors and the state in which they are found, the hub's configuration,
//! whether a service manager keeps ports, the consumers. Refuses to know what happens later.

use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use config::{Config, Sources};
use lms::variant::{Baud, Variant};
use lms::{MILLIS, Nanos};
use schema::{Failure, Topic};
use sim::ChunkSize;
use sim::machine::{Settings, Start};
use sim::operating::Operating;
use sim::series::{Changes, Series};

use crate::consumer::Habit;
use crate::sensor::{Sensor, series};

/// How a world begins.
pub(crate) struct Setup {
    pub(crate) sensors: Vec<OfSensor>,
    /// A service manager keeps the ports of a killed hub.
    pub(crate) keeps_ports: bool,
    /// Scans in a row that violate a circle.
    pub(crate) min_scans: u64,
    /// What consumers are there from the start: of which sensor and topic, how they behave, how many samples they hold.
    pub(crate) cast: Vec<(usize, Topic, Habit, usize)>,
}

/// One sensor and its link.
pub(crate) struct OfSensor {
    pub(crate) settings: Settings,
    /// What its link asks for.
    pub(crate) variant: Variant,
    pub(crate) baud: Baud,
}

impl Setup {
    pub(crate) fn of_seed(seed: u64) -> Setup {
        let mut random = fastrand::Rng::with_seed(seed);
        let count = random.usize(1..=2);
        let sensors: Vec<OfSensor> = (0..count).map(|_| OfSensor::draw(&mut random)).collect();
        let mut cast = Vec::new();
        for sensor in 0..count {
            cast.extend(Topic::ALL.map(|topic| (sensor, topic, Habit::Prompt, 0)));
            cast.push((sensor, Topic::Zones, Habit::Robot, 0));
            let every_ms = random.u64(5..400);
            cast.push((sensor, Topic::Scan, Habit::Slow { every_ms }, random.usize(0..=4)));
        }
        Setup { sensors, keeps_ports: random.bool(), min_scans: random.u64(1..=2), cast }
    }

    /// The sensors' names in topics.
    pub(crate) fn name(sensor: usize) -> String {
        format!("s{sensor}")
    }

    /// The configuration; the second of `edition` 1 differs in what is made of scans, and that of 2 is refused.
    pub(crate) fn config(&self, edition: u64) -> Result<Config, Failure> {
        let mut set = vec![format!("zones.min_scans={}", self.min_scans)];
        let mut links = Vec::new();
        for (number, sensor) in self.sensors.iter().enumerate() {
            let name = Setup::name(number);
            links.push(format!("{name}=/dev/world/{number}"));
            set.push(format!("link.{name}.baud={}", sensor.baud.rate()));
            set.push(format!("link.{name}.angle={}", sensor.variant.angle_deg));
            set.push(format!("link.{name}.resolution={}", f64::from(sensor.variant.resolution_cdeg) / 100.0));
        }
        match edition {
            0 => {}
            1 => set.extend(["zones.radii=[1.2,0.6]", "background.threshold_mm=70"].map(str::to_owned)),
            _ => set.push("zones.radii=[0.6,1.2]".to_owned()),
        }
        Config::load(&Sources { files: Vec::new(), set, links })
    }

    /// The sensors as they are found, whose view changes as `changes` say.
    pub(crate) fn sensors(&self, mut changes: impl FnMut(usize) -> Changes) -> Vec<Sensor> {
        let sensor = |(number, of): (usize, &OfSensor)| {
            Sensor::new(of.settings.clone(), measured(of.variant), changes(number))
        };
        self.sensors.iter().enumerate().map(sensor).collect()
    }
}

impl OfSensor {
    fn draw(random: &mut fastrand::Rng) -> OfSensor {
        let variant = if random.u8(..8) == 0 { Variant::ALL[random.usize(..5)] } else { Variant::HALF };
        let baud = if random.u8(..6) == 0 { Baud::B38400 } else { Baud::B500000 };
        let found = [baud, Baud::B9600, Baud::B38400, Baud::B19200][random.usize(..4)];
        let states = [
            Start::In(Operating::OnRequest),
            Start::In(Operating::Installation),
            Start::In(Operating::All),
            Start::PowerOn,
        ];
        let settings = Settings {
            baud: found,
            permanent_baud: [None, Some(baud)][random.usize(..2)],
            variant: if random.bool() { variant } else { Variant::HALF },
            start: states[random.usize(..4)].clone(),
            boot_ns: random.u64(100..1_500) * MILLIS,
            chunk: if random.bool() { ChunkSize::Uart } else { ChunkSize::Usb },
            seed: random.u64(..),
            ..Settings::default()
        };
        OfSensor { settings, variant, baud }
    }

    /// Time between two scans, and from the first byte of a telegram to the last, at the rate that the link asks for.
    pub(crate) fn times(&self) -> (Nanos, Nanos) {
        let len = 2 * self.variant.beams() + 10;
        let rate = self.baud.rate();
        let turns = (len - 1) / lms::variant::BYTES_PER_TURN;
        let on_line = lms::line_time(len, rate) + turns as Nanos * lms::variant::MIRROR_TURN;
        (self.variant.period(len, rate), on_line)
    }
}

/// The scans that sensors of `variant` tell, measured once.
fn measured(variant: Variant) -> Arc<Series> {
    type Known = Mutex<Vec<(Variant, Arc<Series>)>>;
    static KNOWN: LazyLock<Known> = LazyLock::new(Known::default);
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    match known.iter().find(|(of, _)| *of == variant) {
        Some((_, series)) => series.clone(),
        None => {
            let made = Arc::new(series(variant));
            known.push((variant, made.clone()));
            made
        }
    }
}
