//! What a sensor whose head turns sent lately, and whether what is published is of it.

use std::collections::hash_map::Entry;

use scanhub_schema::Nanos;

use super::{LONG_GAP, MOST, OfSensor, PROMPT};
use crate::event::Telegram;
use crate::hash::History;

impl OfSensor {
    pub(super) fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let (begin, end) = (std::mem::replace(&mut self.end, telegram.span.1), telegram.span.1);
        if telegram.is_reply {
            return;
        }
        if telegram.damage.is_none() {
            // The line lost all that came between: where nothing else tells, what waits behind it has no time yet.
            if !self.exactness.has_clock && self.arrived_at + LONG_GAP < at {
                self.begin();
            }
            self.arrived_at = at;
        }
        let key = History::of(telegram.bytes);
        let is_double = self.order.back() == Some(&key);
        *self.sent.entry(key).or_default() += 1;
        self.order.push_back(key);
        if is_double || end - begin > telegram.bytes.len() as u64 {
            self.crowded_at = Some(at);
        }
        self.forgotten += usize::from(self.order.len() > MOST);
        if self.order.len() > MOST
            && let Some(Entry::Occupied(mut oldest)) =
                self.order.pop_front().map(|oldest| self.sent.entry(oldest))
        {
            *oldest.get_mut() -= 1;
            if *oldest.get() == 0 {
                oldest.remove();
            }
        }
        if telegram.damage.is_none()
            && let Some(begin) = self.family.begin(telegram.bytes)
            && let Some(measured) = self.last_of(at, &begin, self.family.exactness(telegram.bytes))
            && at < measured + begin.on_line + PROMPT
        {
            self.prompt = Some((telegram.span.1, at));
        }
    }

    /// Whether `unit`, which is published, was sent. Single points without a checksum are so short that pieces of two often
    /// are one that was sent before: they have to come in their order, too.
    pub(super) fn was_sent(&mut self, unit: &[u8]) -> bool {
        let key = History::of(unit);
        if self.exactness.neighbours == 0 {
            return self.sent.contains_key(&key);
        }
        let begin = self.passed.saturating_sub(self.forgotten);
        // What a line doubles was sent once.
        let is_last = begin.checked_sub(1).and_then(|last| self.order.get(last)) == Some(&key);
        let ahead = self.order.iter().skip(begin).position(|sent| *sent == key);
        if !is_last && let Some(ahead) = ahead {
            self.passed = self.forgotten + begin + ahead + 1;
        }
        is_last || ahead.is_some()
    }
}
