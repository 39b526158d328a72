"""The attention-based observation encoder (the paper's section IV-B, figure 3)."""

import flax.linen as nn
import jax
import jax.numpy as jnp


class EntityAttention(nn.Module):
    """Multi-head attention with one query, that of the pursuer itself, over all entities.

    Only the own token's output is used, so the key and value projections are folded to the query's side: instead of
    projecting every entity, the query is taken to the entities' space and the weighted mean of entities is projected.
    Algebraically the same as projecting keys and values of each entity (a key bias cancels in the softmax).
    """

    features: int
    heads: int
    dtype: jnp.dtype

    @nn.compact
    def __call__(self, query: jax.Array, entities: jax.Array, mask: jax.Array) -> jax.Array:
        """query (..., F), entities (..., M, F), mask (..., M) bool -> (..., F)."""
        width = self.features // self.heads
        init = nn.initializers.orthogonal()
        projected = nn.Dense(self.features, dtype=self.dtype, kernel_init=init, name="query")(query)
        projected = projected.reshape(*projected.shape[:-1], self.heads, width)
        key_kernel = self.param("key_kernel", init, (self.features, self.features))
        value_kernel = self.param("value_kernel", init, (self.features, self.features))
        key_kernel = key_kernel.reshape(self.features, self.heads, width).astype(self.dtype)
        value_kernel = value_kernel.reshape(self.features, self.heads, width).astype(self.dtype)

        folded = jnp.einsum("...hd,fhd->...hf", projected, key_kernel)
        score = jnp.einsum("...hf,...mf->...hm", folded, entities, preferred_element_type=jnp.float32)
        score = jnp.where(mask[..., None, :], score * width**-0.5, -1e9)
        weight = jax.nn.softmax(score, axis=-1).astype(self.dtype)
        mean = jnp.einsum("...hm,...mf->...hf", weight, entities)
        attended = jnp.einsum("...hf,fhd->...hd", mean, value_kernel)
        attended = attended.reshape(*attended.shape[:-2], self.features)
        return nn.Dense(self.features, dtype=self.dtype, kernel_init=init, name="output")(attended)


class Encoder(nn.Module):
    """Embeds self, other pursuers and pillars by an MLP per kind, attends, adds the self embedding, one more MLP."""

    features: int
    heads: int
    dtype: jnp.dtype

    @nn.compact
    def __call__(
        self, self_state: jax.Array, others: jax.Array, pillars: jax.Array, pillar_seen: jax.Array
    ) -> jax.Array:
        """self_state (..., S), others (..., A, 3), pillars (..., k, 5), pillar_seen (..., k) bool -> (..., F)."""
        own = self._layer("self_1", self_state)
        own = self._layer("self_2", own)
        tokens = [own[..., None, :], self._layer("pillars", pillars)]
        mask = [jnp.ones((*pillar_seen.shape[:-1], 1), bool), pillar_seen]
        if others.shape[-2] > 0:
            tokens.append(self._layer("others", others))
            mask.append(jnp.ones(others.shape[:-1], bool))
        entities = jnp.concatenate(tokens, axis=-2)
        attention = EntityAttention(self.features, self.heads, self.dtype, name="attention")
        hidden = own + attention(own, entities, jnp.concatenate(mask, axis=-1))
        hidden = nn.LayerNorm(dtype=self.dtype, name="norm")(hidden)
        return self._layer("hidden", hidden)

    def _layer(self, name, x):
        init = nn.initializers.orthogonal(2**0.5)
        x = nn.Dense(self.features, dtype=self.dtype, kernel_init=init, name=name)(x)
        return nn.gelu(nn.LayerNorm(dtype=self.dtype, name=f"{name}_norm")(x))
