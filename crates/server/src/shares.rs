//! Divides a budget between callers.
//!
//! Rule: a caller holds at most half of what the other callers leave. A single caller gets half of
//! the budget, two get a third each, n get 1/(n + 1) each, and as much stays free for a new caller.
//! The switches of packet networks share their buffers by the same rule.
//!
//! Source: Choudhury and Hahne, "Dynamic queue length thresholds for shared-memory packet
//! switches", 1998, with α = 1.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::caller::CallerId;

/// A budget, in any unit, and what each caller holds of it.
#[derive(Debug)]
pub struct Shares {
    budget: usize,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    total: usize,
    /// Callers that hold something.
    by_caller: HashMap<CallerId, usize>,
}

/// Which limit refuses a caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exhausted {
    /// The budget of all callers.
    Budget,
    /// The caller's share of it.
    Share,
}

impl Shares {
    /// Divides `budget`.
    pub fn new(budget: usize) -> Arc<Self> {
        Arc::new(Self {
            budget,
            held: Mutex::default(),
        })
    }

    /// Total amount held.
    pub fn held(&self) -> usize {
        self.lock().total
    }

    /// The whole budget.
    pub fn budget(&self) -> usize {
        self.budget
    }

    /// Takes `amount` for a caller.
    ///
    /// # Errors
    /// The limit that is reached; nothing is taken then.
    pub fn take(self: &Arc<Self>, caller: CallerId, amount: usize) -> Result<Share, Exhausted> {
        let mut share = Share {
            shares: self.clone(),
            caller,
            amount: 0,
        };
        share.grow(amount)?;
        Ok(share)
    }

    fn lock(&self) -> MutexGuard<'_, Held> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// An amount held by a caller, returned when dropped.
#[derive(Debug)]
pub struct Share {
    shares: Arc<Shares>,
    caller: CallerId,
    amount: usize,
}

impl Share {
    /// The amount held.
    #[cfg(test)]
    pub fn amount(&self) -> usize {
        self.amount
    }

    /// Takes more.
    ///
    /// # Errors
    /// The limit that is reached; nothing is taken then.
    pub fn grow(&mut self, amount: usize) -> Result<(), Exhausted> {
        if amount == 0 {
            return Ok(());
        }

        let mut held = self.shares.lock();
        let own = held.by_caller.get(&self.caller).copied().unwrap_or(0);
        let left_by_others = self.shares.budget - (held.total - own);
        let free = left_by_others - own;
        if amount > free {
            return Err(Exhausted::Budget);
        }
        if own + amount > left_by_others.div_ceil(2) {
            return Err(Exhausted::Share);
        }

        held.total += amount;
        *held.by_caller.entry(self.caller.clone()).or_default() += amount;
        self.amount += amount;
        Ok(())
    }

    /// Returns a part, at most all.
    pub fn shrink(&mut self, amount: usize) {
        let amount = amount.min(self.amount);
        if amount == 0 {
            return;
        }

        let mut held = self.shares.lock();
        held.total -= amount;
        if let Entry::Occupied(mut own) = held.by_caller.entry(self.caller.clone()) {
            *own.get_mut() -= amount;
            if *own.get() == 0 {
                own.remove();
            }
        }
        self.amount -= amount;
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.shrink(self.amount);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn takes_all_it_can(shares: &Arc<Shares>, caller: u64) -> Share {
        let mut share = shares.take(CallerId::Connection(caller), 0).unwrap();
        while share.grow(1).is_ok() {}
        share
    }

    /// Oracle: by hand from the rule. The callers come one after the other, and each takes all it
    /// can: half of what the others leave.
    #[test]
    fn a_caller_gets_half_of_what_the_others_leave() {
        let shares = Shares::new(1_000);
        let amounts: Vec<usize> = (0..3)
            .map(|caller| takes_all_it_can(&shares, caller))
            .map(std::mem::ManuallyDrop::new)
            .map(|share| share.amount())
            .collect();
        assert_eq!(amounts, [500, 250, 125]);
        assert_eq!(shares.held(), 875);
    }

    /// Oracle: by hand. A caller that came early and holds more than its share gets nothing new
    /// until it has returned some.
    #[test]
    fn a_share_shrinks_when_others_come() {
        let shares = Shares::new(100);
        let mut first = takes_all_it_can(&shares, 1);
        let second = takes_all_it_can(&shares, 2);
        assert_eq!([first.amount(), second.amount()], [50, 25]);

        first.shrink(10);
        assert_eq!(first.grow(1), Err(Exhausted::Share));
        first.shrink(3);
        assert_eq!(first.grow(1), Ok(()), "38 of 75, rounded up");
        assert_eq!(first.grow(1_000), Err(Exhausted::Budget));
        assert_eq!(first.amount(), 38);

        drop((first, second));
        assert_eq!(shares.held(), 0);
        assert!(shares.lock().by_caller.is_empty());
    }

    /// Oracle: the sum of what the shares hold, after operations in random order.
    #[test]
    fn the_total_is_the_sum_of_the_shares() {
        use rand::{RngExt, SeedableRng};
        use rand_chacha::ChaCha8Rng;

        let shares = Shares::new(10_000);
        let mut random = ChaCha8Rng::seed_from_u64(36);
        let mut held: Vec<Share> = Vec::new();
        for _ in 0..5_000 {
            let amount = random.random_range(0..900);
            let caller = CallerId::Connection(random.random_range(0..7));
            match random.random_range(0..3) {
                0 => held.extend(shares.take(caller, amount)),
                1 if !held.is_empty() => {
                    held.swap_remove(amount % held.len());
                }
                _ => {
                    if let Some(share) = held.last_mut() {
                        share.shrink(amount);
                    }
                }
            }

            let sum: usize = held.iter().map(Share::amount).sum();
            assert_eq!(shares.held(), sum);
            assert!(sum <= shares.budget());
        }
    }
}
