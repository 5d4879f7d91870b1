//! Memory of images while they are decoded.
//!
//! A request waits for it on its worker thread instead of being refused: decoding takes fractions
//! of a second, and each thread decodes one image at a time.

use std::sync::{Condvar, Mutex, PoisonError};

/// A budget for the images that are decoded at one time, bytes.
#[derive(Debug, Default)]
pub struct DecodingMemory {
    budget: u64,
    free: Mutex<u64>,
    freed: Condvar,
}

/// Memory of one image, free again when dropped.
#[derive(Debug)]
pub struct DecodingLease<'a> {
    memory: &'a DecodingMemory,
    bytes: u64,
}

impl DecodingMemory {
    /// A budget of `budget` bytes.
    pub fn new(budget: u64) -> Self {
        Self {
            budget,
            free: Mutex::new(budget),
            freed: Condvar::new(),
        }
    }

    /// Blocks until the memory of an image is free. An image above the whole budget is decoded
    /// alone.
    pub fn wait(&self, bytes: u64) -> DecodingLease<'_> {
        let bytes = bytes.min(self.budget);
        let free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let freed = self.freed.wait_while(free, |free| *free < bytes);
        *freed.unwrap_or_else(PoisonError::into_inner) -= bytes;

        DecodingLease {
            memory: self,
            bytes,
        }
    }
}

impl Drop for DecodingLease<'_> {
    fn drop(&mut self) {
        let free = &self.memory.free;
        *free.lock().unwrap_or_else(PoisonError::into_inner) += self.bytes;
        self.memory.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// Oracle: the contract: the sum of what is held never exceeds the budget, and everyone is
    /// served, also an image above the whole budget.
    #[test]
    fn images_wait_for_memory() {
        let memory = DecodingMemory::new(100);
        let held = AtomicU64::new(0);
        let served = AtomicU64::new(0);
        std::thread::scope(|scope| {
            for bytes in [30, 40, 50, 60, 500, 1, 99] {
                let (memory, held, served) = (&memory, &held, &served);
                scope.spawn(move || {
                    for _ in 0..50 {
                        let lease = memory.wait(bytes);
                        let now = held.fetch_add(lease.bytes, Ordering::SeqCst) + lease.bytes;
                        assert!(now <= 100, "{now}");
                        std::thread::yield_now();
                        held.fetch_sub(lease.bytes, Ordering::SeqCst);
                    }
                    served.fetch_add(1, Ordering::SeqCst);
                });
            }
        });
        assert_eq!(served.load(Ordering::SeqCst), 7);
    }
}
