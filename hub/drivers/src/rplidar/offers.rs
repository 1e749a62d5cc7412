//! The modes that a scanner offers, as far as it told, and which of them is wanted. Knows no conversation.

use crate::rplidar::model::Mode;
use crate::rplidar::packet::Kind;

/// A mode as a scanner describes it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Offer {
    /// Its number.
    pub(crate) id: u8,
    /// Microseconds from one point to the next; nothing before it is known.
    pub(crate) sample_us: Option<f32>,
    pub(crate) kind: Option<Kind>,
    pub(crate) named: Option<Mode>,
}

/// All modes of a scanner.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Offers {
    all: [Offer; Offers::MOST],
    count: usize,
    typical: Option<u8>,
}

impl Offers {
    const MOST: usize = 12;

    /// There are so many modes.
    pub(crate) fn begin(&mut self, count: usize) {
        *self = Offers { count: count.min(Offers::MOST), ..Offers::default() };
        (0..).zip(&mut self.all).for_each(|(id, offer)| offer.id = id);
    }

    pub(crate) fn count(&self) -> usize {
        self.count
    }

    pub(crate) fn nth_mut(&mut self, n: usize) -> Option<&mut Offer> {
        self.all[..self.count].get_mut(n)
    }

    /// The maker recommends this one.
    pub(crate) fn recommend(&mut self, id: u8) {
        self.typical = Some(id);
    }

    /// Of a scanner that does not list its modes: how long a point takes in the two that every one has.
    pub(crate) fn of_old(standard_us: u16, express_us: u16) -> Offers {
        let offer = |us: u16, kind, mode| Offer {
            id: 0,
            sample_us: (us > 0).then_some(f32::from(us)),
            kind: Some(kind),
            named: Some(mode),
        };
        let mut offers = Offers::default();
        offers.all[0] = offer(standard_us, Kind::Standard, Mode::Standard);
        offers.all[1] = offer(express_us, Kind::Express, Mode::Express);
        offers.count = if express_us > 0 { 2 } else { 1 };
        offers
    }

    /// The mode that is wanted, if it is there, on a line of `baud` bits per second, if it has a rate.
    pub(crate) fn wanted(&self, mode: Mode, baud: Option<u32>) -> Option<Offer> {
        let kind = match mode {
            Mode::Standard => Some(Kind::Standard),
            Mode::Express => Some(Kind::Express),
            Mode::DenseBoost => Some(Kind::Dense),
            Mode::UltraDense => Some(Kind::UltraDense),
            Mode::Boost | Mode::Sensitivity | Mode::Stability => None,
        };
        let named = self.possible(baud).find(|offer| offer.named == Some(mode));
        named.or_else(|| self.possible(baud).find(|offer| kind.is_some() && offer.kind == kind))
    }

    /// The fastest one; of two that are as fast the recommended one, and one with a checksum before one without.
    pub(crate) fn fastest(&self, baud: Option<u32>) -> Option<Offer> {
        self.possible(baud).min_by(|a, b| {
            let of = |offer: &Offer| offer.sample_us.unwrap_or(f32::MAX);
            let rank = |offer: &Offer| {
                let is_checked = offer.kind.is_some_and(Kind::is_checked);
                (!is_checked, self.typical != Some(offer.id))
            };
            of(a).total_cmp(&of(b)).then(rank(a).cmp(&rank(b)))
        })
    }

    /// Microseconds from one point to the next in the modes of `kind`: of the wanted one first, else of the fastest.
    pub(crate) fn sample_us(&self, kind: Kind, mode: Option<Mode>) -> Option<f32> {
        let of_kind = || self.of_kind(kind);
        let named = of_kind().filter(|(named, _)| mode.is_some() && *named == mode).map(|(_, us)| us);
        named.reduce(f32::min).or_else(|| of_kind().map(|(_, us)| us).reduce(f32::min))
    }

    /// Of the same the one that is nearest to `us`.
    pub(crate) fn nearest_us(&self, kind: Kind, us: f32) -> Option<f32> {
        self.of_kind(kind).map(|(_, told)| told).min_by(|a, b| (a - us).abs().total_cmp(&(b - us).abs()))
    }

    fn of_kind(&self, kind: Kind) -> impl Iterator<Item = (Option<Mode>, f32)> {
        let all = self.all[..self.count].iter().filter(move |offer| offer.kind == Some(kind));
        all.filter_map(|offer| Some((offer.named, offer.sample_us?)))
    }

    /// Those of which the kind is known here and that the line can carry.
    fn possible(&self, baud: Option<u32>) -> impl Iterator<Item = Offer> {
        self.all[..self.count].iter().copied().filter(move |offer| {
            let Some((kind, baud)) = offer.kind.zip(baud) else { return offer.kind.is_some() };
            let packets_per_second = 1e6 / (offer.sample_us.unwrap_or(1e6) * kind.points() as f32);
            packets_per_second * kind.bytes() as f32 * 10.0 <= baud as f32
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The modes of a real A1M8.
    fn a1() -> Offers {
        let mut offers = Offers::default();
        offers.begin(5);
        let modes = [
            (Mode::Standard, 508.0, Kind::Standard),
            (Mode::Express, 254.0, Kind::Express),
            (Mode::Boost, 127.0, Kind::Ultra),
            (Mode::Sensitivity, 127.0, Kind::Ultra),
            (Mode::Stability, 201.0, Kind::Ultra),
        ];
        for (n, (mode, us, kind)) in modes.into_iter().enumerate() {
            let offer = offers.nth_mut(n).expect("there");
            (offer.named, offer.sample_us, offer.kind) = (Some(mode), Some(us), Some(kind));
        }
        offers.recommend(3);
        offers
    }

    #[test]
    fn the_fastest_that_the_line_carries() {
        assert_eq!(a1().fastest(Some(115_200)).map(|offer| offer.id), Some(3));
        assert_eq!(a1().fastest(Some(100_000)).map(|offer| offer.id), Some(4), "6,840 bytes a second");
        assert_eq!(a1().fastest(Some(57_600)).map(|offer| offer.id), None);
        assert_eq!(a1().fastest(None).map(|offer| offer.id), Some(3));
        assert_eq!(
            Offers::of_old(500, 250).fastest(Some(115_200)).and_then(|offer| offer.kind),
            Some(Kind::Express)
        );
        assert_eq!(
            Offers::of_old(500, 0).fastest(Some(115_200)).and_then(|offer| offer.kind),
            Some(Kind::Standard)
        );
    }

    #[test]
    fn the_one_of_a_name_or_else_of_its_kind() {
        assert_eq!(a1().wanted(Mode::Boost, None).map(|offer| offer.id), Some(2));
        assert_eq!(a1().wanted(Mode::DenseBoost, None).map(|offer| offer.id), None);
        let mut nameless = a1();
        (0..5).for_each(|n| nameless.nth_mut(n).expect("there").named = None);
        assert_eq!(nameless.wanted(Mode::Express, None).map(|offer| offer.id), Some(1));
        assert_eq!(nameless.wanted(Mode::Boost, None).map(|offer| offer.id), None);
    }
}
