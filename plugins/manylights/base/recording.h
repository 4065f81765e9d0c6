#pragma once

/**
 * What dr.freeze needs: it records the kernels of a function once, and replays them with other
 * arrays. It finds these in the objects that the function uses, here by MANYLIGHTS_TRAVERSE. What the
 * host has decided is no array, and has to be told (\ref HostFacts).
 */

#include <cstdint>
#include <drjit/jit.h>
// After the above
#include <drjit/traversable_base.h>

/// Members of a class that are arrays, or have some
#define MANYLIGHTS_TRAVERSE(...)                                                         \
    void traverse_1_cb_ro(void *payload, drjit::detail::traverse_callback_ro fn) const { \
        DRJIT_MAP(DR_TRAVERSE_MEMBER_RO, __VA_ARGS__)                                    \
    }                                                                                    \
    void traverse_1_cb_rw(void *payload, drjit::detail::traverse_callback_rw fn) {       \
        DRJIT_MAP(DR_TRAVERSE_MEMBER_RW, __VA_ARGS__)                                    \
    }

namespace manylights {

namespace dr = drjit;

/// Is a function being recorded? Nothing can be read on the host then
template <typename Float> bool is_recorded() {
    if constexpr (dr::is_jit_v<Float>)
        return jit_flag(JitFlag::FreezingScope);
    else
        return false;
}

/// For a while, what is done is no part of the function that is recorded, and can be read
template <typename Float> class RecordingPause {
public:
    RecordingPause() : m_paused(is_recorded<Float>()) {
        if constexpr (dr::is_jit_v<Float>)
            if (m_paused)
                jit_freeze_pause(dr::backend_v<Float>);
    }
    ~RecordingPause() {
        if constexpr (dr::is_jit_v<Float>)
            if (m_paused)
                jit_freeze_resume(dr::backend_v<Float>);
    }
    RecordingPause(const RecordingPause &) = delete;

private:
    bool m_paused;
};

/// While dr.freeze looks for arrays, it holds a lock that evaluation may wait for
class TraversalUnlock {
public:
    TraversalUnlock() { jit_state_unlock(); }
    ~TraversalUnlock() { jit_state_lock(); }
    TraversalUnlock(const TraversalUnlock &) = delete;
};

/// A number on the host that decides what is recorded. dr.freeze turns numbers that change into
/// arrays, but records anew if arrays come in another order: each bit is one of two of them.
template <typename UInt32> class HostFacts {
public:
    void set(uint64_t facts) {
        m_facts = facts;
        if (dr::width(m_bits[1]) == 0)
            for (uint32_t i = 0; i < 2; ++i)
                m_bits[i] = dr::opaque<UInt32>(i);
    }

    void traverse_1_cb_ro(void *payload, dr::detail::traverse_callback_ro fn) const {
        for (uint32_t i = 0; i < 64; ++i)
            dr::traverse_1_fn_ro(m_bits[bit(i)], payload, fn);
    }
    void traverse_1_cb_rw(void *payload, dr::detail::traverse_callback_rw fn) {
        for (uint32_t i = 0; i < 64; ++i)
            dr::traverse_1_fn_rw(m_bits[bit(i)], payload, fn);
    }

private:
    uint32_t bit(uint32_t i) const { return (uint32_t) (m_facts >> i) & 1u; }

    uint64_t m_facts = 0;
    UInt32 m_bits[2];
};

} // namespace manylights
