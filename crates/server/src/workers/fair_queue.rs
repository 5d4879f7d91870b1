//! A queue that shares worker time between callers.
//!
//! Each caller has a clock of the worker time it has used. The next job is one of the caller that
//! has used the least. The clock of the queue is that of a caller with an equal share: it advances
//! by the worker time divided by the number of active callers. A caller that was idle starts at
//! the clock of the queue, so it cannot save up time. The time of a job is not known when it
//! starts, so the caller is charged the time of its previous job, and the difference when the job
//! ends.
//!
//! Source: Demers, Keshav and Shenker, "Analysis and simulation of a fair queuing algorithm",
//! 1989; start times from Goyal, Vin and Cheng, "Start-time fair queuing", 1996.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::time::Duration;

use super::super::caller::CallerId;

/// Number of paused jobs of a caller from which on it begins no new ones. Each keeps a thread of
/// the operating system.
const MOST_PAUSED_OF_CALLER: usize = 4;
/// Number of idle callers that are kept before the queue removes those without debt.
const MOST_IDLE: usize = 64;

/// Order of a caller's own jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Urgency {
    /// A frame of an open stream: before the caller's requests.
    Frame,
    Request,
    /// A request that has begun: after the others, so that they get turns too, until the caller has
    /// several of this kind.
    Paused,
}

/// Waiting jobs of type `T` and the worker time that their callers have used.
#[derive(Debug)]
pub struct FairQueue<T> {
    accounts: HashMap<CallerId, Account<T>>,
    /// Callers with waiting jobs, by the time they have used.
    order: BTreeSet<(Duration, CallerId)>,
    /// The clock of the queue.
    now: Duration,
    /// Number of callers with waiting or running jobs.
    active: u32,
}

#[derive(Debug)]
struct Account<T> {
    /// Worker time used, on the clock of the queue.
    used: Duration,
    /// Time of the previous job, which the next one is charged at its start.
    expected: Duration,
    running: usize,
    frames: VecDeque<T>,
    requests: VecDeque<T>,
    /// Jobs that have begun and were paused.
    paused: VecDeque<T>,
}

impl<T> Account<T> {
    fn new(now: Duration) -> Self {
        Self {
            used: now,
            expected: Duration::ZERO,
            running: 0,
            frames: VecDeque::new(),
            requests: VecDeque::new(),
            paused: VecDeque::new(),
        }
    }

    fn waits(&self) -> bool {
        !self.frames.is_empty() || !self.requests.is_empty() || !self.paused.is_empty()
    }

    /// The next job: a frame, then a new request, unless too many are paused already.
    fn next(&mut self) -> Option<T> {
        if let Some(frame) = self.frames.pop_front() {
            return Some(frame);
        }
        if self.paused.len() < MOST_PAUSED_OF_CALLER
            && let Some(request) = self.requests.pop_front()
        {
            return Some(request);
        }
        self.paused.pop_front()
    }

    fn is_idle(&self) -> bool {
        self.running == 0 && !self.waits()
    }
}

impl<T> Default for FairQueue<T> {
    fn default() -> Self {
        Self {
            accounts: HashMap::new(),
            order: BTreeSet::new(),
            now: Duration::ZERO,
            active: 0,
        }
    }
}

impl<T> FairQueue<T> {
    /// Whether no job waits.
    pub fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Adds a job at the end of its caller's jobs.
    pub fn push(&mut self, caller: &CallerId, urgency: Urgency, job: T) {
        let account = self.activated(caller);
        let was_waiting = account.waits();
        match urgency {
            Urgency::Frame => account.frames.push_back(job),
            Urgency::Request => account.requests.push_back(job),
            Urgency::Paused => account.paused.push_back(job),
        }

        let used = account.used;
        if !was_waiting {
            self.order.insert((used, caller.clone()));
        }
    }

    /// Removes the next job and starts it. Also returns its caller and the time charged for it.
    pub fn pop(&mut self) -> Option<(CallerId, T, Duration)> {
        let (_, caller) = self.order.pop_first()?;
        let account = self.accounts.get_mut(&caller)?;
        let job = account.next()?;
        account.running += 1;

        let charged = self.started(&caller);
        Some((caller, job, charged))
    }

    /// Starts a job of `caller` that did not wait. Returns the time charged for it.
    pub fn start(&mut self, caller: &CallerId) -> Duration {
        self.activated(caller).running += 1;
        self.started(caller)
    }

    /// Charges the caller for a job that starts.
    fn started(&mut self, caller: &CallerId) -> Duration {
        let Some(account) = self.accounts.get(caller) else {
            return Duration::ZERO;
        };
        let charged = account.expected;
        self.now = self.now.max(account.used);
        self.charge(caller, charged, Duration::ZERO);
        charged
    }

    /// Ends a job that took `elapsed`, of which `charged` was charged at its start.
    pub fn end(&mut self, caller: &CallerId, elapsed: Duration, charged: Duration) {
        self.charge(caller, elapsed, charged);
        self.now += elapsed / self.active.max(1);
        if let Some(account) = self.accounts.get_mut(caller) {
            account.running -= 1;
            account.expected = elapsed;
            self.active -= u32::from(account.is_idle());
        }

        // Idle callers are forgotten once they have no debt. Looking for them at each end would
        // cost more than keeping some.
        let has_many_idle = self.accounts.len() > self.order.len() + MOST_IDLE;
        if has_many_idle {
            let now = self.now;
            self.accounts
                .retain(|_, account| !account.is_idle() || account.used > now);
        }
    }

    /// Removes a waiting job.
    pub fn remove(&mut self, caller: &CallerId, is_job: impl Fn(&T) -> bool) {
        let Some(account) = self.accounts.get_mut(caller) else {
            return;
        };
        let was_waiting = account.waits();
        account.frames.retain(|job| !is_job(job));
        account.requests.retain(|job| !is_job(job));
        account.paused.retain(|job| !is_job(job));
        if was_waiting && !account.waits() {
            self.order.remove(&(account.used, caller.clone()));
            self.active -= u32::from(account.is_idle());
        }
    }

    /// The account of a caller that gets a job. The clock of an idle caller is set to the queue's,
    /// unless it is ahead.
    fn activated(&mut self, caller: &CallerId) -> &mut Account<T> {
        let now = self.now;
        let account = self.accounts.entry(caller.clone());
        let account = account.or_insert_with(|| Account::new(now));
        if account.is_idle() {
            account.used = account.used.max(now);
            self.active += 1;
        }
        account
    }

    /// Adds `more` to the caller's clock, after `less` was taken off.
    fn charge(&mut self, caller: &CallerId, more: Duration, less: Duration) {
        let Some(account) = self.accounts.get_mut(caller) else {
            return;
        };
        if account.waits() {
            self.order.remove(&(account.used, caller.clone()));
        }
        account.used = (account.used + more).saturating_sub(less);
        if account.waits() {
            self.order.insert((account.used, caller.clone()));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn caller(number: u64) -> CallerId {
        CallerId::Connection(number)
    }

    /// Runs `total` of jobs one after the other on one thread; returns the time of each caller.
    fn served(queue: &mut FairQueue<Duration>, total: Duration) -> HashMap<CallerId, Duration> {
        let mut clock = Duration::ZERO;
        let mut served: HashMap<CallerId, Duration> = HashMap::new();
        while clock < total {
            let Some((caller, length, charged)) = queue.pop() else {
                break;
            };
            clock += length;
            *served.entry(caller.clone()).or_default() += length;
            queue.end(&caller, length, charged);
        }
        served
    }

    /// Oracle: the definition of a fair share: two callers that always wait get the same time,
    /// whatever their jobs take and however many they have.
    #[test]
    fn callers_get_the_same_time() {
        let mut queue = FairQueue::default();
        for _ in 0..1_000 {
            queue.push(&caller(1), Urgency::Request, 40 * MS);
        }
        for _ in 0..200 {
            queue.push(&caller(2), Urgency::Request, 5 * MS);
        }

        let served = served(&mut queue, 2_000 * MS);
        let [first, second] = [1, 2].map(|number| served[&caller(number)]);
        assert!(first.abs_diff(second) <= 80 * MS, "{first:?} {second:?}");
    }

    /// Oracle: the contract: at most one job of each other caller is before a caller that was idle.
    #[test]
    fn a_new_caller_is_next() {
        let mut queue = FairQueue::default();
        for _ in 0..1_000 {
            queue.push(&caller(1), Urgency::Request, 40 * MS);
        }
        served(&mut queue, 400 * MS);

        queue.push(&caller(2), Urgency::Request, MS);
        let next: Vec<CallerId> = (0..2).filter_map(|_| Some(queue.pop()?.0)).collect();
        assert!(next.contains(&caller(2)), "{next:?}");
    }

    /// Oracle: the contract: time without jobs is not saved up. After 10 s alone, the first caller
    /// gets no more than the one that waited.
    #[test]
    fn an_idle_caller_saves_nothing_up() {
        let mut queue = FairQueue::default();
        for _ in 0..2_000 {
            queue.push(&caller(1), Urgency::Request, 10 * MS);
        }
        served(&mut queue, 10_000 * MS);

        for _ in 0..1_000 {
            queue.push(&caller(2), Urgency::Request, 10 * MS);
        }
        let served = served(&mut queue, 1_000 * MS);
        assert!(served[&caller(1)] >= 490 * MS, "{served:?}");
        assert!(served[&caller(2)] >= 490 * MS, "{served:?}");
    }

    /// Oracle: the contract: frames are before requests of the same caller, in their order.
    #[test]
    fn frames_are_before_requests() {
        let mut queue = FairQueue::default();
        for (urgency, job) in [
            (Urgency::Request, "request"),
            (Urgency::Frame, "first frame"),
            (Urgency::Frame, "second frame"),
        ] {
            queue.push(&caller(1), urgency, job);
        }
        queue.push(&caller(1), Urgency::Request, "removed");
        queue.remove(&caller(1), |job| *job == "removed");

        let order: Vec<&str> = std::iter::from_fn(|| Some(queue.pop()?.1)).collect();
        assert_eq!(order, ["first frame", "second frame", "request"]);
        assert!(queue.is_empty());
    }

    /// Oracle: the contract, by hand: a caller begins new requests while fewer than four are
    /// paused.
    #[test]
    fn a_caller_pauses_few_requests() {
        let mut queue = FairQueue::default();
        for job in ["fifth", "sixth"] {
            queue.push(&caller(1), Urgency::Request, job);
        }
        for job in ["first", "second", "third", "fourth"] {
            queue.push(&caller(1), Urgency::Paused, job);
        }

        let order: Vec<&str> = std::iter::from_fn(|| Some(queue.pop()?.1)).collect();
        assert_eq!(
            order,
            ["first", "fifth", "sixth", "second", "third", "fourth"]
        );
    }

    /// Oracle: the definition of a fair share: one caller that always waits gets a quarter of the
    /// time beside three that are new each time, although those have no debt.
    #[test]
    fn new_callers_do_not_starve_an_old_one() {
        let mut queue = FairQueue::default();
        let mut old_time = Duration::ZERO;
        let mut next = 2;
        for _ in 0..1_000 {
            queue.push(&caller(1), Urgency::Request, 10 * MS);
        }
        served(&mut queue, 1_000 * MS);

        for _ in 0..3 {
            queue.push(&caller(next), Urgency::Request, 10 * MS);
            next += 1;
        }
        for _ in 0..400 {
            let (ran, length, charged) = queue.pop().unwrap();
            queue.end(&ran, length, charged);
            if ran == caller(1) {
                old_time += length;
            } else {
                queue.push(&caller(next), Urgency::Request, 10 * MS);
                next += 1;
            }
        }
        let share = old_time.as_secs_f64() / (400 * 10 * MS).as_secs_f64();
        assert!((0.15..=0.35).contains(&share), "{share}");
    }

    /// Oracle: the bound on idle callers, after ten thousand callers with one job each.
    #[test]
    fn idle_callers_are_forgotten() {
        let mut queue = FairQueue::default();
        for number in 0..10_000 {
            queue.push(&caller(number), Urgency::Request, MS);
            served(&mut queue, MS);
        }
        assert!(queue.accounts.len() <= MOST_IDLE + 2);
    }
}
