//! Keys as they are pressed: without Enter and without an echo. The terminal is as before when this is over.

use std::io::{IsTerminal, stdin};

use rustix::process::getpgrp;
use rustix::termios::{
    LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
};

/// The keyboard, as long as it is ours.
pub(super) struct Keys {
    before: Termios,
}

impl Keys {
    /// Nothing if there is no keyboard, or if it is somebody else's, as that of a program in the background.
    pub(super) fn take_over() -> Option<Keys> {
        let keyboard = stdin();
        if !keyboard.is_terminal() || tcgetpgrp(&keyboard).ok()? != getpgrp() {
            return None;
        }
        let before = tcgetattr(&keyboard).ok()?;
        let mut ours = before.clone();
        // Ctrl-C stays a signal. A hub that is stopped or breaks off would leave the terminal like this.
        ours.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        ours.special_codes[SpecialCodeIndex::VSUSP] = DISABLED;
        ours.special_codes[SpecialCodeIndex::VQUIT] = DISABLED;
        ours.special_codes[SpecialCodeIndex::VMIN] = 1;
        ours.special_codes[SpecialCodeIndex::VTIME] = 0;
        tcsetattr(&keyboard, OptionalActions::Now, &ours).ok()?;
        Some(Keys { before })
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        // Of a terminal that is gone nothing is to be given back.
        let _ = tcsetattr(stdin(), OptionalActions::Now, &self.before);
    }
}

/// No key does this (_POSIX_VDISABLE).
const DISABLED: u8 = 0;
