//! `scanhub configure`: changes a sensor's EEPROM settings. Reads the settings, shows the difference, asks a person,
//! writes, reads back, and reports the state of the sensor, also after a failure.

mod ask;
mod difference;
mod outcome;
mod wanted;

use std::sync::atomic::AtomicBool;

use lms_configure::{Change, Plan, Step};
use port::{Source, clock};
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::parameters::Password;
use schema::{Failure, Kind};

use crate::drive::drive;
use crate::probe::{ask, open};
pub use difference::Difference;
pub use outcome::Configured;
use wanted::Wanted;

/// What to change, and where.
#[derive(Clone, Debug)]
pub struct Order {
    /// The port.
    pub source: Source,
    /// `KEY=VALUE`, as given.
    pub settings: Vec<String>,
    /// Password of the installation mode: 8 ASCII characters.
    pub password: String,
}

/// Progress and results to report.
#[derive(Debug)]
pub enum News<'a> {
    /// The sensor is looked for at this rate.
    Looking(u32),
    /// One value that would change.
    Difference(&'a Difference),
    /// All differences were told, and a person is asked now.
    Asking,
    /// What is done now, in words.
    Doing(&'static str),
    /// It is over and went well, or there was nothing to change.
    Configured(&'a Configured),
}

/// Carries out `order`; calls `tell` with everything that happens.
///
/// [`Kind::Configuration`] for a key, a value, or what this type of sensor cannot do, before anything is written;
/// [`Kind::Usage`] if no person is at a terminal; the port kinds, [`Kind::Timeout`] if nobody answers,
/// [`Kind::Interrupted`]; [`Kind::Failed`] with the state of the sensor if the change failed or was not confirmed.
pub fn configure(order: &Order, stop: &AtomicBool, tell: &mut dyn FnMut(News<'_>)) -> Result<(), Failure> {
    let wanted = Wanted::parse(&order.settings)?;
    let password = password(&order.password)?;
    let (port, first) = open(&order.source, stop)?;
    let report = ask(&port, first, &order.source, stop, |rate| tell(News::Looking(rate)))?;
    let name = order.source.name();
    let Some(mut plan) = Plan::of(&report) else {
        return Err(Failure::new(
            Kind::Timeout,
            format!("{name}: the sensor does not report its configuration"),
            "nothing was written; power it off and on, then try again",
        ));
    };
    plan.password = password;
    let family = report.kind().and_then(Family::of_type);
    wanted.apply(&mut plan, family, &report)?;
    if plan.is_empty() {
        tell(News::Configured(&Configured::nothing(&name, &plan)));
        return Ok(());
    }
    let was_permanent = report.status().map(|status| status.has_permanent_baud());
    for difference in difference::between(&name, &plan, family, was_permanent) {
        tell(News::Difference(&difference));
    }
    tell(News::Asking);
    let consent = ask::person(plan, stop)?;
    // What a stream has sent meanwhile is not looked at.
    port.discard_input(plan.baud.rate()).map_err(|error| outcome::untouched(&name, &error))?;
    let mut change = Change::new(consent, clock::now());
    if let Source::Tcp { .. } = order.source {
        change = change.behind_server();
    }
    let mut shown = None;
    // An interrupt would leave it half done; it takes seconds, and ends in any case.
    let to_the_end = AtomicBool::new(false);
    let ended = drive(&port, &mut change, &to_the_end, |change| {
        if shown != Some(change.step()) {
            shown = Some(change.step());
            tell(News::Doing(words(change.step())));
        }
    });
    ended.map_err(|failure| outcome::gone(&name, &change, &failure))?;
    let configured = Configured::of(&name, &plan, was_permanent, change.outcome())?;
    tell(News::Configured(&configured));
    Ok(())
}

fn password(text: &str) -> Result<Password, Failure> {
    let refuse = |_| {
        let message = format!("--password: {} characters", text.chars().count());
        Failure::new(Kind::Configuration, message, "a password has 8 ASCII characters, such as SICK_LMS")
    };
    text.as_bytes().try_into().map(Password).map_err(refuse)
}

fn words(step: Step) -> &'static str {
    match step {
        Step::Compare => "checking that nothing has changed",
        Step::Enter => "entering installation mode",
        Step::Write => "writing, which takes up to 15 s",
        Step::Check => "checking what was written",
        Step::PowerOn => "setting the rate after power-on",
        Step::Leave => "leaving installation mode",
        Step::ReadBack | Step::ReadStatus => "reading back",
        Step::Restore => "restarting the stream",
        Step::Done => "done",
    }
}
