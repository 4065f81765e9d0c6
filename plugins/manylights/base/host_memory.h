#pragma once

/**
 * Large arrays on the host, and loops over them on all threads. Independent of variants.
 */

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <drjit/packet.h>
#include <memory>
#include <mutex>
#include <nanothread/nanothread.h>
#include <utility>
#include <vector>

namespace manylights {

/// Leaves the entries of a vector uninitialized: large ones are filled on all threads
template <typename T> struct UninitializedAllocator : std::allocator<T> {
    template <typename U> struct rebind {
        using other = UninitializedAllocator<U>;
    };
    template <typename U> void construct(U *place) { ::new ((void *) place) U; }
    template <typename U, typename... Args> void construct(U *place, Args &&...args) {
        ::new ((void *) place) U(std::forward<Args>(args)...);
    }
};

template <typename T> using HostVector = std::vector<T, UninitializedAllocator<T>>;

/**
 * The threads for all of this. They are not Mitsuba's: a thread that waits for a task takes
 * up others, and there these may be pixels, which would wait for the lights that it builds.
 */
inline Pool *own_threads() {
    static Pool *pool = pool_create(pool_size(nullptr));
    static std::mutex mutex;
    std::lock_guard<std::mutex> guard(mutex);
    if (uint32_t size = pool_size(nullptr); pool_size(pool) != size)
        pool_set_size(pool, size);
    return pool;
}

/// Call f(); all threads do the same with denormal numbers
template <typename F> void run_with_denormals(const F &f) {
    drjit::scoped_flush_denormals guard(false);
    f();
}

/// Tasks that run at the same time as what follows
class Tasks {
public:
    template <typename F> void start(const F &f) {
        m_tasks[m_count++] =
            drjit::do_async([f] { run_with_denormals(f); }, {}, own_threads());
    }
    void wait() {
        while (m_count > 0)
            task_wait_and_release(m_tasks[--m_count]);
    }
    ~Tasks() { wait(); }

private:
    Task *m_tasks[4];
    uint32_t m_count = 0;
};

/// Entries of an array that one task handles. Fixed, so that nothing depends on the number
/// of threads
constexpr size_t kChunk = 1 << 14;

inline size_t chunk_count(size_t size) { return (size + kChunk - 1) / kChunk; }

/// Call f(index of the chunk, begin, end) for all chunks of an array, at the same time
template <typename F> void for_chunks(size_t size, const F &f) {
    auto run = [&](size_t i) {
        run_with_denormals([&] { f(i, i * kChunk, std::min(size, (i + 1) * kChunk)); });
    };
    size_t count = chunk_count(size);
    if (count <= 1)
        return count == 1 ? run(0) : void();
    drjit::parallel_for(
        drjit::blocked_range<size_t>(0, count),
        [&](const auto &range) {
            for (size_t i : range)
                run(i);
        },
        own_threads());
}

} // namespace manylights
