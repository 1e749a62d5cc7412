//! The mount of a sensor from TOML. Described in `docs/worlds.md`.

use std::ops::Range;

use schema::Failure;
use serde::Deserialize;
use toml::Spanned;

use crate::mount::{Fault, FaultKind, Mount};
use crate::world::origin::Origin;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MountFile {
    height_mm: Spanned<f64>,
    arm_mm: Option<(f64, f64)>,
    from_deg: Spanned<f64>,
    to_deg: Spanned<f64>,
    deg_s: Option<Spanned<f64>>,
    reports_hz: Option<Spanned<f64>>,
    #[serde(default)]
    faults: Vec<Spanned<FaultFile>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FaultFile {
    kind: String,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    by_deg: Option<Spanned<f64>>,
    by_s: Option<Spanned<f64>>,
}

impl MountFile {
    pub(crate) fn mount(&self, span: Range<usize>, origin: &Origin) -> Result<Mount, Failure> {
        let within = |value: &Spanned<f64>, allowed| origin.number(&Some(value.clone()), 0.0, allowed);
        let (from_deg, to_deg) = (within(&self.from_deg, -80.0..=80.0)?, within(&self.to_deg, -80.0..=80.0)?);
        if to_deg - from_deg < 1.0 {
            let what = format!("a mount that swings from {from_deg} to {to_deg} degrees");
            return Err(origin.refuse(
                span,
                what,
                "from_deg below to_deg, by a degree at least; down is positive",
            ));
        }
        let faults = self.faults.iter().map(|fault| fault.get_ref().fault(fault.span(), origin));
        Ok(Mount {
            height_mm: within(&self.height_mm, 1.0..=10_000.0)?,
            arm_mm: self.arm_mm.unwrap_or_default(),
            from_deg,
            to_deg,
            deg_s: origin.number(&self.deg_s, 30.0, 1.0..=360.0)?,
            reports_hz: origin.number(&self.reports_hz, 100.0, 1.0..=10_000.0)?,
            faults: faults.collect::<Result<_, _>>()?,
        })
    }
}

impl FaultFile {
    fn fault(&self, span: Range<usize>, origin: &Origin) -> Result<Fault, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let by_deg = || origin.number(&self.by_deg, 8.0, -80.0..=80.0);
        let kind = match self.kind.as_str() {
            "halts" => FaultKind::Halts,
            "silent" => FaultKind::Silent,
            "stuck" => FaultKind::Stuck,
            "jumps" => FaultKind::Jumps(by_deg()?),
            "lies" => FaultKind::Lies(by_deg()?),
            "late" => FaultKind::Late(origin.number(&self.by_s, 0.3, 0.0..=10.0)?),
            other => {
                let remedy = "halts, silent, stuck, jumps or lies with by_deg, late with by_s";
                return Err(origin.refuse(span, format!("kind = \"{other}\""), remedy));
            }
        };
        Ok(Fault { kind, from_s, until_s })
    }
}
