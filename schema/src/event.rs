//! What happened to a person at an instant. Refuses to know how that is found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::text;

/// The payload of topic `events`, 112 bytes. It happened at the sample's `wall_ns`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Event.v2"))]
#[repr(C)]
pub struct Event {
    /// Whom: his number in topic `tracks`.
    pub id: u64,
    /// See [`EventKind`].
    pub kind: u8,
    /// 0.
    pub reserved: [u8; 7],
    /// Name of the room where he then is; empty: none. See [`room_name`](Event::room_name).
    pub room_text: [u8; 24],
    /// Name of the door; empty if it is no event of a door.
    pub door_text: [u8; 24],
    /// Name of the room that he came from, or `outside`; empty if it is no event of a door.
    pub from_text: [u8; 24],
    /// Name of the room that he went to, or `outside`; empty if it is no event of a door.
    pub to_text: [u8; 24],
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum EventKind {
    /// He is known from now on.
    Appeared,
    /// He is gone.
    Left,
    /// He went through a door.
    Door,
}

impl EventKind {
    /// All, in the order of their numbers.
    pub const ALL: [EventKind; 3] = [EventKind::Appeared, EventKind::Left, EventKind::Door];

    /// Returns the word for it in all output.
    pub const fn name(self) -> &'static str {
        match self {
            EventKind::Appeared => "appeared",
            EventKind::Left => "left",
            EventKind::Door => "door",
        }
    }

    /// Returns the kind with this number; nothing if this version does not know it.
    pub fn of_number(number: u8) -> Option<EventKind> {
        EventKind::ALL.get(usize::from(number)).copied()
    }
}

impl Event {
    /// Makes the event of `id`, who then is in `room`.
    pub fn new(kind: EventKind, id: u64, room: Option<&str>) -> Event {
        let mut event = Event { id, kind: kind as u8, ..Event::default() };
        text::write(&mut event.room_text, room.unwrap_or_default());
        event
    }

    /// Returns the event with the door, and the rooms before and behind it.
    pub fn through(mut self, door: &str, from: &str, to: &str) -> Event {
        text::write(&mut self.door_text, door);
        text::write(&mut self.from_text, from);
        text::write(&mut self.to_text, to);
        self
    }

    /// Returns what happened; nothing if this version does not know it.
    pub fn kind(&self) -> Option<EventKind> {
        EventKind::of_number(self.kind)
    }

    /// Returns the room where he then is.
    pub fn room_name(&self) -> Option<&str> {
        Some(text::read(&self.room_text)).filter(|room| !room.is_empty())
    }

    /// Returns the door, from where he came, and where he went; nothing if it is no event of a door.
    pub fn door(&self) -> Option<(&str, &str, &str)> {
        let [door, from, to] =
            [&self.door_text, &self.from_text, &self.to_text].map(|field| text::read(field));
        (self.kind() == Some(EventKind::Door)).then_some((door, from, to))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_says_what_it_was_made_of() {
        let appeared = Event::new(EventKind::Appeared, 3, None);
        assert_eq!(
            (appeared.kind(), appeared.room_name(), appeared.door()),
            (Some(EventKind::Appeared), None, None)
        );
        let door = Event::new(EventKind::Door, 3, Some("kitchen")).through("left", "hall", "kitchen");
        assert_eq!((door.room_name(), door.door()), (Some("kitchen"), Some(("left", "hall", "kitchen"))));
        for (number, kind) in EventKind::ALL.into_iter().enumerate() {
            assert_eq!((kind as usize, EventKind::of_number(number as u8)), (number, Some(kind)));
        }
        assert_eq!(EventKind::of_number(3), None);
    }
}
