//! Payloads whose length goes by the number of beams: a head of fixed size, and arrays behind it, in whole words of eight
//! bytes so that every array is aligned. Refuses to know what is in head and arrays.

/// Makes the type of a payload, and that of its words, by which the shared-memory library knows it.
macro_rules! sliced {
    ($(#[$about:meta])* $payload:ident, $word:ident, $name:tt, $head:ident) => {
        #[doc = concat!("Eight bytes of a [`", stringify!($payload), "`].")]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
        #[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name($name))]
        #[repr(C)]
        pub struct $word {
            word: u64,
        }

        $(#[$about])*
        #[derive(bytemuck::TransparentWrapper)]
        #[repr(transparent)]
        pub struct $payload([$word]);

        impl $payload {
            /// Bytes before the arrays.
            pub const HEAD: usize = size_of::<$head>();

            /// Returns memory for `len` bytes, at least a head, all of it 0.
            pub fn zeroed(len: usize) -> Box<Self> {
                let words = vec![$word::default(); Self::words(len)].into_boxed_slice();
                bytemuck::allocation::TransparentWrapperAlloc::wrap_box(words)
            }

            /// Returns the words that `len` bytes take, at least those of a head.
            pub const fn words(len: usize) -> usize {
                let len = if len > Self::HEAD { len } else { Self::HEAD };
                len.div_ceil(size_of::<$word>())
            }

            /// Returns `words` as they are read.
            pub fn of_words(words: &[$word]) -> &Self {
                bytemuck::TransparentWrapper::wrap_ref(words)
            }

            /// Returns `words` as they are written.
            pub fn of_words_mut(words: &mut [$word]) -> &mut Self {
                bytemuck::TransparentWrapper::wrap_mut(words)
            }

            /// Returns a copy in the memory of this process, as long as what is used.
            pub fn boxed(&self) -> Box<Self> {
                Self::of_bytes(self.bytes())
            }

            /// Returns a copy of what [`bytes`](Self::bytes) returned.
            pub fn of_bytes(bytes: &[u8]) -> Box<Self> {
                let mut copy = Self::zeroed(bytes.len());
                copy.copy_from(bytes);
                copy
            }

            /// Makes `payload` longer if it has memory for fewer than `len` bytes; then it is 0.
            pub fn grow(payload: &mut Box<Self>, len: usize) {
                if payload.capacity() < len {
                    *payload = Self::zeroed(len);
                }
            }

            /// Returns the bytes that there is memory for.
            pub fn capacity(&self) -> usize {
                self.memory().len()
            }

            /// Returns the bytes that are used.
            pub fn bytes(&self) -> &[u8] {
                let memory = self.memory();
                memory.get(..self.used()).unwrap_or(memory)
            }

            /// Writes `bytes` to the beginning; `false` if there is too little memory.
            pub fn copy_from(&mut self, bytes: &[u8]) -> bool {
                let memory = self.memory_mut().get_mut(..bytes.len());
                memory.map(|memory| memory.copy_from_slice(bytes)).is_some()
            }

            fn memory(&self) -> &[u8] {
                bytemuck::cast_slice(&self.0)
            }

            fn memory_mut(&mut self) -> &mut [u8] {
                bytemuck::cast_slice_mut(&mut self.0)
            }
        }

        impl std::ops::Deref for $payload {
            type Target = $head;

            fn deref(&self) -> &$head {
                const NONE: [$word; size_of::<$head>() / size_of::<$word>()] = [$word { word: 0 }; size_of::<$head>() / size_of::<$word>()];
                // A stranger's sample may be shorter than a head: then there are no beams.
                let head = self.memory().get(..Self::HEAD);
                bytemuck::from_bytes(head.unwrap_or(bytemuck::cast_slice(&NONE)))
            }
        }

        impl std::ops::DerefMut for $payload {
            fn deref_mut(&mut self) -> &mut $head {
                bytemuck::from_bytes_mut(&mut self.memory_mut()[..Self::HEAD])
            }
        }

        impl Default for Box<$payload> {
            fn default() -> Self {
                $payload::zeroed(0)
            }
        }

        impl Clone for Box<$payload> {
            fn clone(&self) -> Self {
                self.boxed()
            }
        }

        impl PartialEq for $payload {
            fn eq(&self, other: &Self) -> bool {
                self.bytes() == other.bytes()
            }
        }

        impl Eq for $payload {}
    };
}

pub(crate) use sliced;
