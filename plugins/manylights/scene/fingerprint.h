#pragma once

/**
 * What the lights of a scene depend on, as numbers to compare: the identity (JIT variants)
 * or the values (scalar ones) of the parameters of emitters and their shapes. An emitter has
 * two of them, so that one that has only become brighter is told from one that has moved.
 */

#include "manylights/emission/emission_reader.h"
#include <algorithm>
#include <cstring>
#include <drjit/tensor.h>
#include <mitsuba/core/object.h>
#include <mitsuba/core/transform.h>
#include <mitsuba/core/vector.h>
#include <string_view>
#include <unordered_map>

namespace manylights {

namespace dr = drjit;

class Hash {
public:
    uint64_t value = 0xcbf29ce484222325ull;

    void
    mix(uint64_t word) { // FNV-1a over 64-bit words, and a shift for their upper halves
        value = (value ^ word) * 0x100000001b3ull;
        value ^= value >> 29;
    }

    void mix_bytes(const void *data, size_t size) {
        mix(size);
        const char *bytes = (const char *) data;
        size_t i          = 0;
        if (size >= 64) {
            // Four chains at once: each has to wait for its multiplications. Not on several
            // threads: those that look for more work afterwards would slow the render down
            Hash lanes[4];
            for (int k = 0; k < 4; ++k)
                lanes[k].value += k;
            for (; i + 32 <= size; i += 32)
                for (int k = 0; k < 4; ++k)
                    lanes[k].mix(word(bytes + i + 8 * k, 8));
            for (const Hash &lane : lanes)
                mix(lane.value);
        }
        for (; i < size; i += 8)
            mix(word(bytes + i, std::min<size_t>(8, size - i)));
    }

private:
    static uint64_t word(const char *bytes, size_t size) {
        uint64_t result = 0;
        std::memcpy(&result, bytes, size);
        return result;
    }
};

/// The numbers of all emitters of a scene
template <typename Float> class Fingerprint {
public:
    using Object = mitsuba::Object;

    /// What an emitter emits, and everything else about it
    struct Parts {
        Hash emission, place;
        /// Has what it emits a gradient?
        bool differentiated = false;
    };

    /// An emitter that emits something else
    struct Change {
        uint32_t emitter;
        /// Has that a gradient, and what it emitted before?
        bool differentiated, was_differentiated;
    };

    /// Variables that take the place of others
    using Literals = std::unordered_map<uint32_t, uint32_t>;

    explicit Fingerprint(size_t emitters, Literals literals = {})
        : m_literals(std::move(literals)) {
        m_emitters.reserve(emitters);
    }
    Fingerprint(Fingerprint &&other) { swap(other); }
    Fingerprint &operator=(Fingerprint &&other) {
        swap(other);
        return *this;
    }
    ~Fingerprint() {
        if (m_holds)
            for (uint32_t index : m_variables)
                jit_var_dec_ref(index);
    }

    /// Go on with the next emitter
    void add_emitter(const Object *emitter) {
        add_untouched(emitter);
        add(emitter);
    }

    /// The same for one whose parameters do not matter
    void add_untouched(const Object *emitter) {
        m_emitters.emplace_back();
        m_hash = &m_emitters.back().place;
        mix((uint64_t) emitter);
    }

    /// Mix in an object on which the current emitter depends
    void add(const Object *object) {
        mix((uint64_t) object);
        Visitor visitor(*this);
        const_cast<Object *>(object)->traverse(&visitor);
        if constexpr (dr::is_jit_v<Float>) {
            if (!visitor.complete) {
                dr::scoped_set_flag guard(JitFlag::EnableObjectTraversal, true);
                object->traverse_1_cb_ro(this, mix_variable);
            }
        }
    }

    /// Mix in a number on which the current emitter depends
    void mix(uint64_t value) { m_hash->mix(value); }

    /// Mix in a number on which all lights depend
    void mix_common(uint64_t value) { m_common.mix(value); }

    /// Keep the variables alive, so that no others get their indices
    void hold() {
        if (m_holds)
            return;
        for (uint32_t index : m_variables)
            jit_var_inc_ref(index);
        m_holds = true;
    }

    /// JIT variants: the variables of all emitters and their shapes
    const std::vector<uint32_t> &variables() const { return m_variables; }

    bool operator==(const Fingerprint &other) const {
        return same_places(other) && changed_emission(other).empty();
    }

    /// Does it differ at most in what the emitters emit?
    bool same_places(const Fingerprint &other) const {
        bool same = m_common.value == other.m_common.value &&
                    m_emitters.size() == other.m_emitters.size() &&
                    m_variables.size() == other.m_variables.size();
        for (size_t i = 0; same && i < m_emitters.size(); ++i)
            same = m_emitters[i].place.value == other.m_emitters[i].place.value;
        return same;
    }

    /// Variables that were literals in `other`, with the same value: dr.freeze makes arrays of them
    Literals literals(const Fingerprint &other) const {
        Literals result;
        if constexpr (dr::is_jit_v<Float>) {
            size_t count = std::min(m_variables.size(), other.m_variables.size());
            for (size_t i = 0; i < count; ++i) {
                uint32_t now = m_variables[i], before = other.m_variables[i];
                if (now != before && has_become_array(before, now))
                    result[now] = before;
            }
        }
        return result;
    }

    /// Emitters that emit something else than in `other`
    std::vector<Change> changed_emission(const Fingerprint &other) const {
        std::vector<Change> result;
        for (size_t i = 0; i < m_emitters.size(); ++i) {
            const Parts &now = m_emitters[i], &before = other.m_emitters[i];
            if (now.emission.value != before.emission.value)
                result.push_back(
                    { (uint32_t) i, now.differentiated, before.differentiated });
        }
        return result;
    }

private:
    void swap(Fingerprint &other) {
        std::swap(m_common, other.m_common);
        std::swap(m_emitters, other.m_emitters);
        std::swap(m_variables, other.m_variables);
        std::swap(m_holds, other.m_holds);
    }

    // ------------------------------------------------------------------------- Values

    static bool has_become_array(uint32_t literal, uint32_t array) {
        VarInfo before = jit_var_info(literal), now = jit_var_info(array);
        if (before.state != VarState::Literal || now.state != VarState::Evaluated ||
            before.type != now.type || before.size != now.size)
            return false;
        uint64_t value = 0;
        jit_var_read(array, now.size - 1, &value);
        return value == before.literal;
    }

    /// A changed parameter is a new variable; the upper half tells whether it has a gradient
    static void mix_variable(void *self, uint64_t index, const char *, const char *) {
        Fingerprint &out = *(Fingerprint *) self;
        auto literal     = out.m_literals.find((uint32_t) index);
        if (literal != out.m_literals.end())
            index += (uint64_t) literal->second - (uint32_t) index;
        out.mix(index);
        Parts *parts = out.m_emitters.empty() ? nullptr : &out.m_emitters.back();
        if (parts && out.m_hash == &parts->emission)
            parts->differentiated |= (index >> 32) != 0;
        if ((uint32_t) index)
            out.m_variables.push_back((uint32_t) index);
    }

    template <typename T> static void mix_value(Fingerprint &out, const void *pointer) {
        const T &value = *(const T *) pointer;
        if constexpr (dr::is_tensor_v<T>) {
            for (size_t i = 0; i < value.ndim(); ++i)
                out.mix(value.shape(i));
            mix_value<std::decay_t<decltype(value.array())>>(out, &value.array());
        } else if constexpr (dr::is_jit_v<T> ||
                             (dr::is_jit_v<Float> && dr::is_drjit_struct_v<T>) ) {
            dr::traverse_1_fn_ro(value, &out, mix_variable);
        } else if constexpr (dr::is_dynamic_array_v<T>) {
            out.m_hash->mix_bytes(value.data(), value.size() * sizeof(dr::scalar_t<T>));
        } else {
            out.m_hash->mix_bytes(&value, sizeof(T));
        }
    }

    using Mixer = void (*)(Fingerprint &, const void *);

    /// The mixer of a type if it is one of `Ts`
    template <typename... Ts> static Mixer find_mixer(const std::type_info &type) {
        Mixer result = nullptr;
        ((type == typeid(Ts) ? void(result = mix_value<Ts>) : void()), ...);
        return result;
    }

    /// The mixer of any type that parameters have; null for others
    static Mixer find_mixer_of(const std::type_info &type) {
        using UInt32 = dr::uint32_array_t<Float>;
        using Int32  = dr::int32_array_t<Float>;
        using Single = dr::replace_scalar_t<Float, float>;
        using Core   = mitsuba::CoreAliases<Float>;
        return find_mixer<
            bool, float, double, int32_t, uint32_t, Float, UInt32, Int32,
            dr::mask_t<Float>, mitsuba::Color<Float, 1>, mitsuba::Color<Float, 3>,
            mitsuba::Point<Float, 2>, mitsuba::Point<Float, 3>, mitsuba::Vector<Float, 2>,
            mitsuba::Vector<Float, 3>, typename Core::AffineTransform3f,
            typename Core::AffineTransform4f, typename Core::ProjectiveTransform4f,
            mitsuba::DynamicBuffer<Single>, mitsuba::DynamicBuffer<UInt32>,
            mitsuba::DynamicBuffer<typename Core::Float16>, typename Core::TensorXf,
            typename Core::TensorXf16, typename Core::TensorXf32>(type);
    }

    /// Mix in a value of any type; false if its type is not known
    bool mix_any(const void *value, const std::type_info &type) {
        for (auto [known, mixer] : m_mixers)
            if (known == &type)
                return mixer && (mixer(*this, value), true);
        m_mixers.push_back({ &type, find_mixer_of(type) });
        return mix_any(value, type);
    }

    struct Visitor : mitsuba::TraversalCallback {
        Fingerprint &out;
        /// Were all types known?
        bool complete = true;

        explicit Visitor(Fingerprint &out) : out(out) {}

        void put_value(std::string_view, void *value, uint32_t,
                       const std::type_info &type) override {
            complete &= out.mix_any(value, type);
        }

        void put_object(std::string_view name, Object *object, uint32_t) override {
            if (!object || contains(kUnrelated, name))
                return;
            Parts &parts = out.m_emitters.back();
            Hash *outer  = out.m_hash;
            if (contains(kEmissionNames, name))
                out.m_hash = &parts.emission;
            out.mix((uint64_t) object);
            object->traverse(this);
            out.m_hash = outer;
        }
    };

    template <typename Names>
    static bool contains(const Names &names, std::string_view name) {
        return std::find(std::begin(names), std::end(names), name) != std::end(names);
    }

    /// Children of emitters and shapes that have nothing to do with the light they emit
    static constexpr std::string_view kUnrelated[] = {
        "bsdf", "emitter", "sensor", "medium", "interior_medium", "exterior_medium"
    };

    Literals m_literals;
    std::vector<Parts> m_emitters;
    Hash m_common;
    /// Where the current parameter belongs
    Hash *m_hash = &m_common;
    /// JIT variants: the variables, and whether they are kept alive
    std::vector<uint32_t> m_variables;
    bool m_holds = false;
    /// How to mix the types seen so far: comparing addresses is faster than names
    std::vector<std::pair<const std::type_info *, Mixer>> m_mixers;
};

} // namespace manylights
