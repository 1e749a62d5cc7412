//! Models of the LMS family, with their factory settings and their limits.

use crate::line::family::named;
use crate::lms::command::{
    CARTESIAN, COUNTERS, FIELD, FIELD_SET, RANGE_FIELDS, REFLECTIVITIES, REFLECTIVITY, Request,
};
use crate::lms::operating::Operating;
use crate::lms::variant::{Unit, Variant};

named! {
    /// Model of a scanner.
    LmsModel {
        /// Indoor scanner.
        Lms200 "lms200",
        /// Outdoor scanner behind a window of 100 degrees.
        Lms211 "lms211",
        /// Outdoor scanner. An LMS 220 counts as an LMS 221.
        Lms221 "lms221",
        /// Indoor scanner with long range.
        Lms291 "lms291",
        /// Version S14 of an LMS 211, 221 or 291: twice as fast as the other versions, with 90 degrees at 0.5 as its
        /// only variant.
        Fast "s14",
    }
}

impl LmsModel {
    /// Returns the model with this name in the configuration.
    pub fn of_name(name: &str) -> Option<LmsModel> {
        LmsModel::ALL.into_iter().find(|family| family.name().eq_ignore_ascii_case(name))
    }

    /// Returns the model in a type reply such as `LMS200;S18063;V02.19`. Returns `None` if the reply contains no known
    /// model.
    pub fn of_type(text: &[u8]) -> Option<LmsModel> {
        let mut parts = text.split(|&byte| byte == b';');
        let (kind, version) = (parts.next()?, parts.next().unwrap_or_default());
        let family = match kind {
            b"LMS200" => LmsModel::Lms200,
            b"LMS211" => LmsModel::Lms211,
            b"LMS220" | b"LMS221" => LmsModel::Lms221,
            b"LMS291" => LmsModel::Lms291,
            _ => return None,
        };
        Some(if version.starts_with(b"S14") { LmsModel::Fast } else { family })
    }

    /// Returns the factory setting of angle and resolution. Returns `None` for [`LmsModel::Fast`], whose angle and
    /// resolution are not a [`Variant`].
    pub fn factory_variant(self) -> Option<Variant> {
        match self {
            LmsModel::Lms200 | LmsModel::Lms221 | LmsModel::Lms291 => Some(Variant::HALF),
            LmsModel::Lms211 => Variant::new(100, 50),
            LmsModel::Fast => None,
        }
    }

    /// Returns the factory setting of the unit. With mm, ranges reach up to 8 m. With cm, they reach up to 80 m.
    pub fn factory_unit(self) -> Unit {
        match self {
            LmsModel::Lms200 => Unit::Mm,
            LmsModel::Lms211 | LmsModel::Lms221 | LmsModel::Lms291 | LmsModel::Fast => Unit::Cm,
        }
    }

    /// Returns the reason why the model cannot scan `variant`. Returns `None` if the model can scan it.
    pub fn refuses_variant(self, variant: Variant) -> Option<&'static str> {
        match self {
            LmsModel::Lms211 if variant.angle_deg > 100 => Some("its window is 100 degrees wide"),
            LmsModel::Fast => Some("it scans 90 degrees at 0.5 and cannot be switched"),
            _ => None,
        }
    }

    /// Returns the reason why the model has no sensitivity setting (byte 3 of the configuration, 0 to 3). Returns
    /// `None` if it has this setting. For the other models, byte 3 is a peak threshold.
    pub fn refuses_sensitivity(self) -> Option<&'static str> {
        (self != LmsModel::Lms291)
            .then_some("only the LMS 291 has a sensitivity; here the byte is a peak threshold")
    }

    /// Returns the reason why the model cannot execute `request`. Returns `None` if the model can execute it.
    pub fn refuses(self, request: Request) -> Option<&'static str> {
        match request {
            Request::Variant(variant) => self.refuses_variant(variant),
            // A model supports such a mode only if it supports the command that requests the same data once.
            Request::Operate(Operating::Reflectivity(_)) => self.refuses_command(REFLECTIVITY),
            Request::Operate(Operating::RangeFields(_)) => self.refuses_command(RANGE_FIELDS),
            Request::Operate(Operating::Reflectivities(_)) => self.refuses_command(REFLECTIVITIES),
            _ => self.refuses_command(request.command()),
        }
    }

    /// Returns the reason why the model does not support `command` (Telegram listing table 7-1). Returns `None` if the
    /// model supports it. `command` may also be a command that writes the EEPROM.
    pub fn refuses_command(self, command: u8) -> Option<&'static str> {
        match (command, self) {
            (COUNTERS, LmsModel::Lms200) => Some("only the LMS 211, 221 and 291 count their hours"),
            (REFLECTIVITY, _) if self != LmsModel::Fast => {
                Some("only version S14 sends ranges and reflectivity together like this")
            }
            (RANGE_FIELDS | FIELD_SET | FIELD, LmsModel::Fast) => Some("version S14 has no fields"),
            (_, LmsModel::Fast) if FIELD_WRITE_COMMANDS.contains(&command) => {
                Some("version S14 has no fields")
            }
            (REFLECTIVITIES | CARTESIAN, LmsModel::Fast) => Some("version S14 does not have this command"),
            _ => None,
        }
    }
}

/// Commands that write fields. This module does not depend on `lms_configure`, which encodes these commands, so their
/// codes are repeated here.
const FIELD_WRITE_COMMANDS: &[u8] = &[0x40, 0x46];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::{SubRange, SubRanges};

    #[test]
    fn recognizes_model_from_type_text() {
        for (text, family) in [
            ("LMS200;S18063;V02.19", Some(LmsModel::Lms200)),
            ("LMS200;301063;V02.10 ", Some(LmsModel::Lms200)),
            ("LMS211;302063;V02.30", Some(LmsModel::Lms211)),
            ("LMS220;301063;V02.10", Some(LmsModel::Lms221)),
            ("LMS221;S16063;V02.30", Some(LmsModel::Lms221)),
            ("LMS291;S05063;V02.30", Some(LmsModel::Lms291)),
            ("LMS291;S14063;X01.27", Some(LmsModel::Fast)),
            ("LMS291", Some(LmsModel::Lms291)),
            ("LMS400;301063", None),
            ("", None),
        ] {
            assert_eq!(LmsModel::of_type(text.as_bytes()), family, "{text}");
        }
        for family in LmsModel::ALL {
            assert_eq!(LmsModel::of_name(family.name()), Some(family));
        }
        assert_eq!(LmsModel::of_name("lms100"), None);
    }

    #[test]
    fn each_model_refuses_unsupported_requests() {
        let span = SubRange { first: 1, last: 2 };
        assert!(LmsModel::Lms200.refuses(Request::Counters).is_some());
        assert!(LmsModel::Lms211.refuses(Request::Counters).is_none());
        assert!(LmsModel::Lms211.refuses(Request::Variant(Variant::HALF)).unwrap().contains("100 degrees"));
        assert!(LmsModel::Lms211.refuses_variant(Variant::new(100, 25).unwrap()).is_none());
        assert!(LmsModel::Lms291.refuses(Request::Reflectivity(span)).is_some());
        assert!(LmsModel::Lms291.refuses(Request::Operate(Operating::Reflectivity(span))).is_some());
        assert!(LmsModel::Fast.refuses(Request::Operate(Operating::Reflectivity(span))).is_none());
        assert!(LmsModel::Fast.refuses(Request::Variant(Variant::HALF)).is_some());
        let spans = SubRanges::new(&[span]).unwrap();
        for operating in [Operating::RangeFields(span), Operating::Reflectivities(spans)] {
            assert!(LmsModel::Fast.refuses(Request::Operate(operating)).is_some());
            assert!(LmsModel::Lms291.refuses(Request::Operate(operating)).is_none());
        }
        for command in [0x3E, 0x40, 0x41, 0x45, 0x46, 0x75, 0x76] {
            assert!(LmsModel::Fast.refuses_command(command).is_some(), "{command:02X}");
            assert!(LmsModel::Lms200.refuses_command(command).is_none(), "{command:02X}");
        }
        assert!(
            LmsModel::Lms291.refuses_sensitivity().is_none()
                && LmsModel::Lms221.refuses_sensitivity().is_some()
        );
    }

    #[test]
    fn factory_variant_is_supported_by_its_model() {
        for family in LmsModel::ALL {
            let refused = family.factory_variant().and_then(|variant| family.refuses_variant(variant));
            assert_eq!(refused, None);
        }
    }
}
