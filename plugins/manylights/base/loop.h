#pragma once

#include <drjit/autodiff.h>
#include <drjit/jit.h>
#include <drjit/packet.h>
#include <drjit/while_loop.h>
#include <stdexcept>

namespace manylights {

namespace dr = drjit;

/// A recorded loop computes something that has a derivative
struct DifferentiatedLoop {};

/// Has any part of a state a derivative?
template <typename State> bool has_gradient(State &state) {
    dr::vector<uint64_t> indices;
    dr::detail::collect_indices<false>(state, indices);
    for (uint64_t index : indices)
        if (ad_grad_enabled(index))
            return true;
    return false;
}

/**
 * Run `body(state)` while `cond(state)` holds: recorded once in JIT variants, a plain
 * loop without copies of the state in scalar ones.
 *
 * To differentiate a recorded loop, Dr.Jit calls `body` again when all that it refers to is
 * gone. This is not let happen: see \ref differentiable.
 */
template <typename State, typename Cond, typename Body>
void loop(State &state, const Cond &cond, const Body &body, const char *name) {
    if constexpr (std::is_same_v<std::decay_t<decltype(cond(state))>, bool>) {
        (void) name;
        while (cond(state))
            body(state);
    } else {
        auto checked = [&](State &s) {
            body(s);
            if (jit_flag(JitFlag::SymbolicLoops) && has_gradient(s))
                throw DifferentiatedLoop();
        };
        dr::tie(state) =
            dr::while_loop(dr::make_tuple(std::move(state)), cond, checked, name);
    }
}

/// Returns f(), with evaluated loops if a derivative passes through any of them, or if that is
/// asked for. They may change the state of `object`.
template <typename Float, typename Object, typename F>
auto differentiable(Object *object, bool evaluated, const F &f) {
    if constexpr (dr::is_diff_v<Float>) {
        if (evaluated) {
            dr::scoped_set_flag guard(JitFlag::SymbolicLoops, false);
            return f();
        }
        dr::detail::index64_vector before;
        dr::detail::collect_indices<true>(object, before);
        try {
            return f();
        } catch (const DifferentiatedLoop &) {
            dr::detail::update_indices(object, before);
        }
        if (jit_flag(JitFlag::SymbolicScope))
            throw std::runtime_error(
                "manylights: sample() cannot be differentiated inside of a recorded loop "
                "or "
                "call. Set drjit.JitFlag.SymbolicLoops to False around it.");
        dr::scoped_set_flag guard(JitFlag::SymbolicLoops, false);
        return f();
    } else {
        (void) object;
        (void) evaluated;
        return f();
    }
}

/**
 * Call `f` with all inlined that it calls, but what is MI_NOINLINE: the rare and the long.
 * For scalar variants, where calls of short functions take time; kernels of JIT variants have
 * none.
 */
template <typename Float, typename F> [[gnu::flatten]] auto call_inlined(const F &f) {
    return f();
}
template <typename Float, typename F> auto call_flat(const F &f) {
    if constexpr (dr::is_jit_v<Float>)
        return f();
    else
        return call_inlined<Float>(f);
}

/// The value without its derivative, as a type that cannot carry one: choices are made with
/// these, so that gradients flow through the chosen lights' values only
template <typename T> auto plain(const T &value) { return dr::detach<false>(value); }

/// Are derivatives of a value wanted? Then zeros are of consequence, too
template <typename T> bool has_derivatives(const T &value) {
    if constexpr (dr::is_diff_v<T>)
        return dr::grad_enabled(value);
    else
        return false;
}

/// Root mean square of the channels of a colour
template <typename Color> auto root_mean_square(const Color &color) {
    return dr::norm(color) * .57735027f;
}

/// Four numbers: an array of four JIT variables, or one SIMD register
template <typename Float>
using Four = std::conditional_t<dr::is_jit_v<Float>, dr::Array<Float, 4>,
                                dr::Packet<dr::scalar_t<Float>, 4>>;

} // namespace manylights
