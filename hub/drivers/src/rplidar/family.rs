//! The family as a configuration and a hub see it.

use core::fmt;

use crate::line;
use crate::line::Turn;
use crate::line::family::{Condition, Features, Turning, Wanted};
use schema::Nanos;

use crate::rplidar::model::{Mode, Model};
use crate::rplidar::session::{Session, Settings};
use crate::rplidar::told::{Health, Info, Trouble};

impl Turning for Session {
    const FEATURES: Features = Features {
        models: &MODELS,
        // Room for all but the S2 and the S3.
        auto: line::family::Model { name: "auto", baud: Model::A1.baud(), beams: 2_048 },
        modes: &MODES,
        can_rest: true,
        speaks_unasked: false,
    };

    fn begin(wanted: Wanted, now: Nanos) -> Self {
        let Wanted { model, mode, beams, most_beams, fixed_rate, listen_only, stop_when_idle } = wanted;
        let (model, mode) = (model.and_then(Model::named), mode.and_then(Mode::named));
        let settings = Settings { model, mode, beams, most_beams, fixed_rate, listen_only, stop_when_idle };
        Session::new(settings, now)
    }

    fn model(&self) -> Option<line::family::Model> {
        self.model().map(described)
    }

    fn beams(&self) -> Option<usize> {
        self.beams()
    }

    fn begun(&self) -> Option<Turn<'_>> {
        self.begun_turn()
    }

    fn other_model(&self) -> Option<line::family::Model> {
        self.info().and_then(|info| info.model()).filter(|model| self.is_wrong(*model)).map(described)
    }

    fn lacks(&self) -> Option<&'static str> {
        (line::Session::trouble(self) == Some(Trouble::Alike)).then_some("model or mode")
    }

    fn specify(&self, text: &mut dyn fmt::Write) {
        let _ = self.mode().map_or(Ok(()), |mode| write!(text, " {}", mode.name()));
        if let Some(Info { firmware: (major, minor), .. }) = self.info() {
            let _ = write!(text, " {major}.{minor:02}");
        }
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.scanner_time
    }

    fn doubt(&mut self, reasons: u8) {
        self.reads.doubt(reasons);
    }

    fn introduction(&self, identity: &mut dyn fmt::Write, health: &mut dyn fmt::Write) -> Option<Condition> {
        let info = self.info().filter(|_| self.is_introduced())?;
        let (major, minor) = info.firmware;
        let _ = write!(identity, "firmware {major}.{minor:02}, hardware {}, number ", info.hardware);
        let _ = info.serial.iter().try_for_each(|byte| write!(identity, "{byte:02X}"));
        let Some(said) = self.health() else { return Some(Condition::Unknown) };
        let _ = write!(health, "{said}");
        Some(match said {
            Health::Good => Condition::Good,
            Health::Warning(_) => Condition::Warning,
            Health::Error(_) => Condition::Error,
        })
    }
}

const fn described(model: Model) -> line::family::Model {
    line::family::Model { name: model.name(), baud: model.baud(), beams: model.beams() }
}

const MODELS: [line::family::Model; Model::ALL.len()] = {
    let mut all = [described(Model::A1); Model::ALL.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = described(Model::ALL[at]);
        at += 1;
    }
    all
};

const MODES: [&str; Mode::ALL.len()] = {
    let mut all = [""; Mode::ALL.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = Mode::ALL[at].name();
        at += 1;
    }
    all
};
