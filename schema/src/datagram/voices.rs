//! Who sends under one hub and epoch. Each gateway has its own number, so a second one with the same number is a copy, for
//! example of its disk: what both send must not become one stream. They are distinguished by their senders and by the
//! hub's run (`boot`) that they announce. Refuses to know what a sender is: any number that differs between two of them.

/// The senders of one life of a gateway.
#[derive(Clone, Copy)]
pub(super) struct Voices {
    /// The first is the one whose life it is.
    all: [Voice; VOICES],
    count: usize,
    is_shared: bool,
}

/// One sender.
#[derive(Clone, Copy, Default)]
struct Voice {
    from: u64,
    /// The hub's lives that it announced, the last one first; 0 is none.
    boots: [u64; BOOTS],
    heard_ns: u64,
    announced_ns: u64,
    /// Since when it announces a life of the hub that the first one does not.
    other_since_ns: Option<u64>,
}

/// Whose a datagram is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Whose {
    /// The gateway's that is heard.
    Own,
    /// Another gateway's with the same number, or not known to be the same one's.
    Twin,
    /// Another one's, and the one that was heard is silent: its life is over. Never where two are known to send: then a
    /// sample of the one would appear under the other one's name.
    Next,
}

/// Senders that are kept apart: the gateway's own sockets, another gateway's, and one for somebody who comes between.
const VOICES: usize = 4;
/// A hub that starts again has another life; announcements of the one before may come late.
const BOOTS: usize = 4;
/// So long nothing comes before a sender counts as silent: three announcements.
pub(super) const SILENT_NS: u64 = 3_000_000_000;
/// So long two senders announce different lives of a hub before they are two gateways: the sockets of one gateway change
/// over within milliseconds.
const SHARED_NS: u64 = 500_000_000;

impl Voices {
    /// Nobody was heard.
    pub(super) const NONE: Voices = Voices {
        all: [Voice { from: 0, boots: [0; BOOTS], heard_ns: 0, announced_ns: 0, other_since_ns: None };
            VOICES],
        count: 0,
        is_shared: false,
    };

    /// Whose it is what came `from` a sender; `boot` if it is an announcement. A sender that has not announced itself is
    /// not taken for the same gateway.
    pub(super) fn judge(&self, from: u64, boot: Option<u64>, now_ns: u64) -> Whose {
        let known = &self.all[..self.count];
        let Some(first) = known.first().filter(|first| first.from != from) else { return Whose::Own };
        let announced = known.iter().find(|voice| voice.from == from).map(|voice| voice.boots[0]);
        let boot = boot.or(announced).filter(|boot| *boot != 0);
        match boot.is_some_and(|boot| first.boots.contains(&boot)) {
            true => Whose::Own,
            false if first.is_silent(now_ns) && !self.is_shared => Whose::Next,
            false => Whose::Twin,
        }
    }

    /// Something came `from` a sender: it was taken, or refused as a twin's.
    pub(super) fn note(&mut self, from: u64, boot: Option<u64>, now_ns: u64) {
        let is_own = self.judge(from, boot, now_ns) == Whose::Own;
        let first = self.all[0];
        let at = self.place(from);
        let voice = &mut self.all[at];
        voice.heard_ns = now_ns;
        if let Some(boot) = boot {
            voice.announce(boot, now_ns);
        }
        if at == 0 {
            return;
        }
        if is_own {
            voice.other_since_ns = None;
            if first.is_silent(now_ns) {
                // The gateway goes on at another address.
                voice.boots = first.boots;
                self.all[..=at].rotate_right(1);
            }
        } else if boot.is_some() && first.boots[0] != 0 {
            let since_ns = *voice.other_since_ns.get_or_insert(now_ns);
            let is_long = now_ns.saturating_sub(since_ns) >= SHARED_NS;
            self.is_shared |= is_long && first.announced_ns > since_ns;
        }
    }

    /// The gateway goes on at `from`, and announced there another life of its hub.
    pub(super) fn move_to(&mut self, from: u64, boot: u64, now_ns: u64) {
        let boots = self.all[0].boots;
        let at = self.place(from);
        self.all[at].boots = boots;
        self.all[at].announce(boot, now_ns);
        self.all[at].heard_ns = now_ns;
        self.all[at].other_since_ns = None;
        self.all[..=at].rotate_right(1);
    }

    /// Two gateways are known to send.
    pub(super) fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// Where `from` stands; whoever was not heard for longest makes room for a new one, but for the first.
    fn place(&mut self, from: u64) -> usize {
        if let Some(at) = self.all[..self.count].iter().position(|voice| voice.from == from) {
            return at;
        }
        let at = if self.count < VOICES {
            self.count += 1;
            self.count - 1
        } else {
            (1..VOICES).min_by_key(|&at| self.all[at].heard_ns).unwrap_or(VOICES - 1)
        };
        self.all[at] = Voice { from, ..Voice::default() };
        at
    }
}

impl Voice {
    fn is_silent(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.heard_ns) >= SILENT_NS
    }

    fn announce(&mut self, boot: u64, now_ns: u64) {
        self.announced_ns = now_ns;
        let at = self.boots.iter().position(|known| *known == boot).unwrap_or(BOOTS - 1);
        self.boots[..=at].rotate_right(1);
        self.boots[0] = boot;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Hears it as an account does.
    fn hear(voices: &mut Voices, from: u64, boot: Option<u64>, at_ms: u64) -> Whose {
        let whose = voices.judge(from, boot, at_ms * MS);
        if whose == Whose::Next {
            *voices = Voices::NONE;
        }
        voices.note(from, boot, at_ms * MS);
        whose
    }

    #[test]
    fn two_gateways_are_kept_apart_and_known_after_two_announcements() {
        let mut voices = Voices::NONE;
        assert_eq!(hear(&mut voices, 1, None, 0), Whose::Own);
        assert_eq!(hear(&mut voices, 2, None, 1), Whose::Twin, "it did not say who it is");
        let mut told_ms = None;
        for at_ms in 2..3000 {
            let boot = |begin: u64| (at_ms % 1000 == begin).then_some(begin);
            assert_eq!(hear(&mut voices, 1, boot(10), at_ms), Whose::Own);
            assert_eq!(hear(&mut voices, 2, boot(300), at_ms), Whose::Twin);
            if voices.is_shared() {
                told_ms.get_or_insert(at_ms);
            }
        }
        assert_eq!(told_ms, Some(1300));
        for (from, boot) in [(2, None), (2, Some(300)), (3, Some(9))] {
            assert_eq!(
                hear(&mut voices, from, boot, 60_000),
                Whose::Twin,
                "nobody stands in for the first one"
            );
        }
        assert_eq!(hear(&mut voices, 3, Some(10), 60_100), Whose::Own, "the first one at another address");
    }

    #[test]
    fn sockets_of_one_gateway_are_one_also_when_its_hub_starts_again() {
        let mut voices = Voices::NONE;
        for second in 0..20 {
            // Copies arrive first, one of them late; the hub starts again every five seconds.
            let boot = 7 + second / 5;
            let late = if second == 11 { boot - 1 } else { boot };
            hear(&mut voices, 2, Some(late), 1000 * second);
            assert_eq!(hear(&mut voices, 1, Some(boot), 1000 * second + 2), Whose::Own, "{second}");
            assert_eq!(hear(&mut voices, 2, Some(boot), 1000 * second + 3), Whose::Own, "{second}");
            assert_eq!(hear(&mut voices, 2, None, 1000 * second + 4), Whose::Own, "{second}");
            assert!(!voices.is_shared(), "{second}");
        }
    }

    #[test]
    fn a_gateway_whose_address_changed_goes_on_and_another_one_begins_anew() {
        let mut voices = Voices::NONE;
        hear(&mut voices, 1, Some(7), 0);
        assert_eq!(hear(&mut voices, 2, None, 100), Whose::Twin);
        assert_eq!(hear(&mut voices, 2, Some(7), 900), Whose::Own);
        assert_eq!(hear(&mut voices, 2, None, 4000), Whose::Own);
        assert_eq!(hear(&mut voices, 2, Some(8), 4100), Whose::Own, "its hub started again");
        assert_eq!(hear(&mut voices, 3, Some(9), 4200), Whose::Twin);
        assert_eq!(hear(&mut voices, 3, Some(9), 7099), Whose::Twin);
        assert_eq!(hear(&mut voices, 3, Some(9), 7100), Whose::Next);
        assert_eq!(hear(&mut voices, 3, None, 7200), Whose::Own);
    }

    #[test]
    fn strangers_put_out_neither_the_gateway_nor_what_is_known_of_it() {
        let mut voices = Voices::NONE;
        hear(&mut voices, 1, Some(7), 0);
        for n in 0..1000 {
            assert_eq!(hear(&mut voices, 100 + n, Some(1000 + n), n), Whose::Twin);
        }
        assert_eq!(hear(&mut voices, 1, None, 1000), Whose::Own);
        assert_eq!(hear(&mut voices, 2, Some(7), 1000), Whose::Own);
    }
}
