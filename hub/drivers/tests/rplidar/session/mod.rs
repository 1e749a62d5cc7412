//! Sessions with heads that answer and turn, over lines that damage what they carry, in virtual time.

mod bench;
mod encode;
mod head;
mod replay;
mod start;
mod stream;
mod wire;
