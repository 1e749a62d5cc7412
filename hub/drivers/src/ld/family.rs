//! The family as a configuration and a hub see it.

use crate::line;
use crate::line::Turn;
use crate::line::family::{Features, Turning, Wanted};
use schema::Nanos;

use crate::ld::model::Model;
use crate::ld::session::{Session, Settings};

impl Turning for Session {
    const FEATURES: Features = Features {
        models: &ALL,
        // Room for all but the STL27L.
        auto: line::family::Model { name: "auto", baud: Model::Ld19.baud(), beams: 720 },
        modes: &[],
        can_rest: false,
        speaks_unasked: true,
    };

    fn begin(wanted: Wanted, now: Nanos) -> Self {
        let Wanted { model, beams, most_beams, fixed_rate, .. } = wanted;
        Session::new(Settings { model: model.and_then(Model::named), beams, most_beams, fixed_rate }, now)
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
        self.other_model().map(described)
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.scanner_time
    }

    fn doubt(&mut self, reasons: u8) {
        self.reads.doubt(reasons);
    }
}

const fn described(model: Model) -> line::family::Model {
    line::family::Model { name: model.name(), baud: model.baud(), beams: model.beams() }
}

const ALL: [line::family::Model; Model::ALL.len()] = {
    let mut all = [described(Model::Ld19); Model::ALL.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = described(Model::ALL[at]);
        at += 1;
    }
    all
};
