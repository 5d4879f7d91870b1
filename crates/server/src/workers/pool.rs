//! Threads of one lane, shared between callers in time slices.

use std::cell::{Cell, RefCell};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::super::caller::CallerId;
use super::super::shares::{Exhausted, Share, Shares};
use super::fair_queue::{FairQueue, Urgency};

/// Time slice of a job while other jobs wait.
const SLICE: Duration = Duration::from_millis(10);
/// Maximum number of jobs of a lane that wait for something else than a thread.
const MOST_OFF: usize = 64;
/// Maximum number of paused jobs of a lane. Each keeps a thread of the operating system.
const MOST_PAUSED: usize = 256;

thread_local! {
    /// The turn of the job that runs on this thread.
    static TURN: RefCell<Option<Turn>> = const { RefCell::new(None) };
    /// Whether this thread, which is one of the async runtime, computes an answer in place.
    static IN_PLACE: Cell<bool> = const { Cell::new(false) };
}

/// The threads of a lane and its queue.
#[derive(Debug, Clone)]
pub struct Pool {
    state: Arc<Mutex<State>>,
    /// Places in the queue for requests, divided between callers. Frames of streams need none.
    places: Arc<Shares>,
    /// Places for jobs that wait for something else than a thread, divided between callers.
    off: Arc<Shares>,
}

#[derive(Debug)]
struct State {
    free: usize,
    /// Not empty only while no thread is free.
    waiting: FairQueue<Waiting>,
    paused: usize,
    last_ticket: u64,
}

#[derive(Debug)]
struct Waiting {
    ticket: u64,
    granted: oneshot::Sender<Turn>,
}

/// The right to use a thread. Dropping it passes the thread to the next job.
#[derive(Debug)]
pub struct Turn {
    pool: Pool,
    caller: CallerId,
    began: Instant,
    charged: Duration,
    /// Whether the thread was passed on already.
    is_over: bool,
}

/// Removes a waiting job from the queue if it is no longer wanted.
struct Ticket<'a> {
    pool: &'a Pool,
    caller: &'a CallerId,
    number: u64,
}

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        let mut state = self.pool.lock();
        state
            .waiting
            .remove(self.caller, |waiting| waiting.ticket == self.number);
    }
}

impl Pool {
    /// A pool of `threads` with `places` for waiting requests.
    pub fn new(threads: usize, places: usize) -> Self {
        Self {
            state: Arc::new(Mutex::new(State {
                free: threads,
                waiting: FairQueue::default(),
                paused: 0,
                last_ticket: 0,
            })),
            places: Shares::new(places),
            off: Shares::new(MOST_OFF),
        }
    }

    /// Waits for a thread. A request is refused if its caller has no place left in the queue.
    ///
    /// # Errors
    /// The limit that is reached.
    pub async fn turn(&self, caller: &CallerId, urgency: Urgency) -> Result<Turn, Exhausted> {
        let (granted, turn) = oneshot::channel();
        let (ticket, _place) = {
            let mut state = self.lock();
            if let Some(turn) = self.free_turn(&mut state, caller) {
                return Ok(turn);
            }

            let place = self.place(caller, urgency)?;
            (state.wait(caller, urgency, granted), place)
        };

        // If this future is dropped, the job leaves the queue.
        let _ticket = Ticket {
            pool: self,
            caller,
            number: ticket,
        };
        turn.await.map_err(|_| Exhausted::Budget)
    }

    /// A thread, if one is free now.
    pub fn turn_now(&self, caller: &CallerId) -> Option<Turn> {
        self.free_turn(&mut self.lock(), caller)
    }

    fn free_turn(&self, state: &mut State, caller: &CallerId) -> Option<Turn> {
        state.free = state.free.checked_sub(1)?;
        let charged = state.waiting.start(caller);
        Some(self.begin(caller.clone(), charged))
    }

    /// Waits for a thread, for a job that has had one before. Blocks.
    fn next_turn(&self, caller: CallerId) -> Turn {
        let (granted, turn) = oneshot::channel();
        let mut state = self.lock();
        if let Some(turn) = self.free_turn(&mut state, &caller) {
            return turn;
        }
        state.wait(&caller, Urgency::Paused, granted);
        drop(state);

        // The sender is in the queue of this pool until it sends.
        let mut over = self.begin(caller, Duration::ZERO);
        over.is_over = true;
        turn.blocking_recv().unwrap_or(over)
    }

    fn place(&self, caller: &CallerId, urgency: Urgency) -> Result<Option<Share>, Exhausted> {
        match urgency {
            Urgency::Frame => Ok(None),
            Urgency::Request | Urgency::Paused => self.places.take(caller.clone(), 1).map(Some),
        }
    }

    fn begin(&self, caller: CallerId, charged: Duration) -> Turn {
        Turn {
            pool: self.clone(),
            caller,
            began: Instant::now(),
            charged,
            is_over: false,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Passes a thread to the next job that is still wanted.
    fn pass_on(&self, state: &mut State) {
        while let Some((caller, waiting, charged)) = state.waiting.pop() {
            let turn = self.begin(caller, charged);
            match waiting.granted.send(turn) {
                Ok(()) => return,
                Err(mut unwanted) => {
                    unwanted.is_over = true;
                    state
                        .waiting
                        .end(&unwanted.caller, Duration::ZERO, unwanted.charged);
                }
            }
        }
        state.free += 1;
    }
}

impl State {
    /// Adds a job to the queue; returns its ticket.
    fn wait(&mut self, caller: &CallerId, urgency: Urgency, granted: oneshot::Sender<Turn>) -> u64 {
        self.last_ticket += 1;
        let ticket = self.last_ticket;
        let waiting = Waiting { ticket, granted };
        self.waiting.push(caller, urgency, waiting);
        ticket
    }
}

impl Turn {
    /// Runs `work` on this thread, paused by [`pause_if_others_wait`] when its slice is over.
    pub fn run<T>(self, work: impl FnOnce() -> T) -> T {
        /// Ends the turn also if the work panics.
        struct End;
        impl Drop for End {
            fn drop(&mut self) {
                drop(TURN.take());
            }
        }

        TURN.set(Some(self));
        let _end = End;
        work()
    }

    /// Runs brief work on this thread of the async runtime.
    pub fn run_in_place<T>(self, work: impl FnOnce() -> T) -> T {
        /// Ends it also if the work panics.
        struct End;
        impl Drop for End {
            fn drop(&mut self) {
                IN_PLACE.set(false);
            }
        }

        IN_PLACE.set(true);
        let _end = End;
        work()
    }

    /// Passes the thread on and waits for the next turn, if the slice is over and others wait.
    /// Blocks the thread of the operating system meanwhile.
    fn paused(mut self) -> Self {
        let elapsed = self.began.elapsed();
        if elapsed < SLICE {
            return self;
        }

        let pool = self.pool.clone();
        let mut state = pool.lock();
        if state.waiting.is_empty() || state.paused >= MOST_PAUSED {
            return self;
        }

        let (granted, turn) = oneshot::channel();
        self.is_over = true;
        state.waiting.end(&self.caller, elapsed, self.charged);
        state.wait(&self.caller, Urgency::Paused, granted);
        state.paused += 1;
        pool.pass_on(&mut state);
        drop(state);

        let turn = turn.blocking_recv();
        pool.lock().paused -= 1;
        // The sender is in the queue of `pool` until it sends.
        turn.unwrap_or(self)
    }
}

/// Runs work that waits for something else than a thread, such as the disk, while the lane's thread
/// serves other jobs. Blocks the thread of the operating system. On other threads it only runs the
/// work.
///
/// # Errors
/// The limit of waiting jobs that is reached.
pub fn off_the_lane<T>(work: impl FnOnce() -> T) -> Result<T, Exhausted> {
    // The runtime moves its other tasks to another thread.
    if IN_PLACE.get() {
        return Ok(tokio::task::block_in_place(work));
    }
    let Some(turn) = TURN.take() else {
        return Ok(work());
    };
    let (pool, caller) = (turn.pool.clone(), turn.caller.clone());
    let place = match pool.off.take(caller.clone(), 1) {
        Ok(place) => place,
        Err(limit) => {
            TURN.set(Some(turn));
            return Err(limit);
        }
    };
    drop(turn);

    let result = work();
    drop(place);
    TURN.set(Some(pool.next_turn(caller)));
    Ok(result)
}

impl Drop for Turn {
    fn drop(&mut self) {
        if self.is_over {
            return;
        }
        let pool = self.pool.clone();
        let mut state = pool.lock();
        let elapsed = self.began.elapsed();
        state.waiting.end(&self.caller, elapsed, self.charged);
        pool.pass_on(&mut state);
    }
}

/// Lets waiting jobs of the lane run if the time slice of the job on this thread is over. Does
/// nothing on other threads.
pub fn pause_if_others_wait() {
    if let Some(turn) = TURN.take() {
        TURN.set(Some(turn.paused()));
    }
}
