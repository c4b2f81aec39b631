	.file	"<string>"
	.section	.rodata.cst8,"aM",@progbits,8
	.p2align	3, 0x0
.LCPI0_0:
	.quad	0x7ff0000000000000
.LCPI0_1:
	.quad	0xfff0000000000000
	.section	.ltext,"axl",@progbits
	.globl	_ZN6pemviz3stl5loops12all_extremesB2v1B40c8tJTIeFIjxB2IKSgI4CrvSCKg1MMfAwK4LIaQIAE117Task_28array_28float64_2c_202d_2c_20C_29_2c_20int64_2c_20int64_2c_20float64_2c_20float64_2c_20float64_2c_20float64_295ArrayIdLi1E1C7mutable7alignedE5ArrayIdLi1E1C7mutable7alignedE
	.p2align	4
	.type	_ZN6pemviz3stl5loops12all_extremesB2v1B40c8tJTIeFIjxB2IKSgI4CrvSCKg1MMfAwK4LIaQIAE117Task_28array_28float64_2c_202d_2c_20C_29_2c_20int64_2c_20int64_2c_20float64_2c_20float64_2c_20float64_2c_20float64_295ArrayIdLi1E1C7mutable7alignedE5ArrayIdLi1E1C7mutable7alignedE,@function
_ZN6pemviz3stl5loops12all_extremesB2v1B40c8tJTIeFIjxB2IKSgI4CrvSCKg1MMfAwK4LIaQIAE117Task_28array_28float64_2c_202d_2c_20C_29_2c_20int64_2c_20int64_2c_20float64_2c_20float64_2c_20float64_2c_20float64_295ArrayIdLi1E1C7mutable7alignedE5ArrayIdLi1E1C7mutable7alignedE:
	pushq	%rbp
	pushq	%r15
	pushq	%r14
	pushq	%r13
	pushq	%r12
	pushq	%rbx
	subq	$808, %rsp
	movq	%rdi, 312(%rsp)
	movq	920(%rsp), %rdi
	movq	976(%rsp), %rbx
	movabsq	$NRT_incref, %r14
	vmovsd	%xmm3, 280(%rsp)
	vmovsd	%xmm2, 304(%rsp)
	movq	%r9, %rbp
	movq	%r8, %r15
	movq	%rcx, %r13
	movq	%rdx, %r12
	movq	%rsi, (%rsp)
	movq	$0, 392(%rsp)
	callq	*%r14
	movq	%rbx, %rdi
	callq	*%r14
	movq	%r12, %rdi
	callq	*%r14
	vmovapd	864(%rsp), %xmm0
	vmovupd	888(%rsp), %xmm1
	movq	880(%rsp), %rax
	movq	%r12, 536(%rsp)
	movq	%r13, 544(%rsp)
	movq	%r15, 552(%rsp)
	movq	%rbp, 560(%rsp)
	movq	%r12, 24(%rsp)
	movq	%r15, 272(%rsp)
	leaq	272(%rsp), %r8
	leaq	392(%rsp), %r9
	movl	$2, %edi
	movl	$1, %ecx
	leaq	576(%rsp), %rsi
	leaq	592(%rsp), %rdx
	vmovupd	%xmm0, 568(%rsp)
	movq	%rax, 584(%rsp)
	vmovupd	%xmm1, 592(%rsp)
	movabsq	$numba_attempt_nocopy_reshape, %rax
	pushq	$0
	pushq	%rbp
	callq	*%rax
	addq	$16, %rsp
	testl	%eax, %eax
	je	.LBB0_1
	movq	536(%rsp), %rdi
	movq	568(%rsp), %rax
	movq	272(%rsp), %rbx
	movq	%rax, 8(%rsp)
	movq	%rdi, (%rsp)
	callq	*%r14
	cmpq	$0, 936(%rsp)
	movabsq	$.LCPI0_0, %rcx
	movabsq	$.LCPI0_1, %rdx
	movabsq	$NRT_decref, %rbp
	jle	.LBB0_24
	movq	912(%rsp), %rsi
	movq	904(%rsp), %rdi
	vbroadcastsd	(%rcx), %zmm1
	movq	880(%rsp), %rax
	vbroadcastsd	(%rdx), %zmm0
	vxorpd	%xmm2, %xmm2, %xmm2
	movq	%rbx, 256(%rsp)
	vmovupd	%zmm2, 32(%rsp)
	xorl	%r14d, %r14d
	movq	%rsi, %r8
	subq	%rdi, %r8
	subq	%rsi, %rax
	leaq	7(%rdi), %r10
	leaq	-8(%rdi), %rcx
	leaq	7(%r8), %r9
	movq	%r10, 336(%rsp)
	shrq	$3, %r10
	leaq	7(%rax), %rsi
	leaq	-8(%r8), %r12
	leaq	-8(%rax), %r15
	movq	%r8, 264(%rsp)
	movq	%rcx, 240(%rsp)
	movq	%rax, 368(%rsp)
	movq	%r9, 360(%rsp)
	shrq	$3, %r9
	movq	%rsi, 328(%rsp)
	shrq	$3, %rsi
	movq	%r10, 352(%rsp)
	movl	%r9d, %r11d
	movq	%r9, 376(%rsp)
	andq	$-8, %r9
	andl	$7, %r11d
	movq	%rsi, 344(%rsp)
	movq	%r9, 320(%rsp)
	movl	%r10d, %r9d
	andl	$7, %r9d
	andq	$-8, %r10
	movq	%r11, 248(%rsp)
	vmovupd	%zmm1, 672(%rsp)
	vmovupd	%zmm1, 96(%rsp)
	vmovupd	%zmm0, 736(%rsp)
	vmovupd	%zmm0, 160(%rsp)
	movq	%r9, 232(%rsp)
	movl	%esi, %r9d
	andl	$7, %r9d
	andq	$-8, %rsi
	movq	%r10, 296(%rsp)
	movq	%r9, 224(%rsp)
	movq	%rsi, 288(%rsp)
	jmp	.LBB0_26
	.p2align	4
.LBB0_51:
	movq	24(%rsp), %rdi
	movq	(%rsp), %rbx
.LBB0_17:
	movq	384(%rsp), %r14
	leaq	1(%r14), %r13
	vzeroupper
	callq	*%rbp
	movq	%rbx, %rdi
	callq	*%rbp
	vmovupd	400(%rsp), %zmm1
	vmovupd	464(%rsp), %zmm2
	movq	952(%rsp), %rax
	vextractf64x4	$1, %zmm1, %ymm0
	vminpd	%ymm1, %ymm0, %ymm0
	vextractf128	$1, %ymm0, %xmm1
	vminpd	%xmm0, %xmm1, %xmm0
	vshufpd	$1, %xmm0, %xmm0, %xmm1
	vminsd	%xmm0, %xmm1, %xmm0
	vextractf64x4	$1, %zmm2, %ymm1
	vmovsd	%xmm0, (%rax,%r14,8)
	movq	1008(%rsp), %rax
	vmaxpd	%ymm2, %ymm1, %ymm1
	vextractf128	$1, %ymm1, %xmm2
	vmaxpd	%xmm1, %xmm2, %xmm1
	vshufpd	$1, %xmm1, %xmm1, %xmm2
	vmaxsd	%xmm1, %xmm2, %xmm1
	vmovsd	%xmm1, (%rax,%r14,8)
	movq	%r13, %r14
	cmpq	936(%rsp), %r13
	je	.LBB0_18
.LBB0_26:
	movq	24(%rsp), %rdi
	movq	%rbp, %rbx
	movabsq	$NRT_incref, %rbp
	vzeroupper
	callq	*%rbp
	movq	(%rsp), %r13
	movq	%r13, %rdi
	callq	*%rbp
	movq	%r14, 384(%rsp)
	imulq	880(%rsp), %r14
	movq	904(%rsp), %rax
	movq	%r13, %rdi
	movq	%r14, 16(%rsp)
	addq	%rax, %r14
	callq	*%rbp
	movq	264(%rsp), %rdx
	cmpq	$7, %rdx
	jg	.LBB0_40
	movq	256(%rsp), %r13
	testq	%rdx, %rdx
	jle	.LBB0_28
	movq	8(%rsp), %rax
	movq	%r14, %rcx
	sarq	$63, %rcx
	vxorpd	%xmm1, %xmm1, %xmm1
	movq	%rbx, %rbp
	andq	%r13, %rcx
	leaq	(%rax,%r14,8), %rax
	vbroadcastsd	(%rax,%rcx,8), %zmm0
	vminpd	672(%rsp), %zmm0, %zmm3
	vmaxpd	736(%rsp), %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vaddsd	%xmm1, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm1
	cmpq	$1, %rdx
	jne	.LBB0_31
	movq	16(%rsp), %rbx
	vmovupd	%zmm1, 608(%rsp)
	vmovupd	%zmm3, 400(%rsp)
	vmovupd	%zmm2, 464(%rsp)
	jmp	.LBB0_39
	.p2align	4
.LBB0_40:
	cmpq	$0, 376(%rsp)
	movq	256(%rsp), %r13
	je	.LBB0_41
	movq	8(%rsp), %rax
	cmpq	$64, 360(%rsp)
	movabsq	$.LCPI0_0, %rcx
	movabsq	$.LCPI0_1, %rdx
	movq	%rbx, %rbp
	leaq	(%rax,%r14,8), %rax
	jae	.LBB0_44
	vbroadcastsd	(%rcx), %zmm1
	vbroadcastsd	(%rdx), %zmm0
	movq	16(%rsp), %rbx
	vxorpd	%xmm5, %xmm5, %xmm5
	xorl	%ecx, %ecx
	vmovups	%zmm1, 400(%rsp)
	vmovupd	32(%rsp), %zmm1
	vmovupd	%zmm0, 464(%rsp)
	jmp	.LBB0_47
.LBB0_28:
	vmovupd	736(%rsp), %zmm2
	vmovupd	672(%rsp), %zmm1
	movq	%rbx, %rbp
	movq	16(%rsp), %rbx
	vxorpd	%xmm0, %xmm0, %xmm0
	vmovupd	%zmm0, 608(%rsp)
	vmovupd	%zmm2, 464(%rsp)
	vmovupd	%zmm1, 400(%rsp)
	jmp	.LBB0_39
.LBB0_41:
	movabsq	$.LCPI0_0, %rax
	movq	%rbx, %rbp
	movq	(%rsp), %rdi
	movq	16(%rsp), %rbx
	vxorpd	%xmm5, %xmm5, %xmm5
	vbroadcastsd	(%rax), %zmm0
	movabsq	$.LCPI0_1, %rax
	vbroadcastsd	(%rax), %zmm1
	vmovupd	%zmm0, 400(%rsp)
	vmovups	%zmm1, 464(%rsp)
	vmovupd	32(%rsp), %zmm1
	jmp	.LBB0_50
.LBB0_31:
	cmpq	$-1, %r14
	movl	$0, %ecx
	movq	16(%rsp), %rbx
	cmovlq	%r13, %rcx
	vbroadcastsd	8(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vaddpd	%zmm0, %zmm1, %zmm0
	cmpq	$2, %rdx
	je	.LBB0_32
	cmpq	$-2, %r14
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	16(%rax,%rcx,8), %zmm1
	vminpd	%zmm3, %zmm1, %zmm3
	vmaxpd	%zmm2, %zmm1, %zmm2
	vsubsd	%xmm1, %xmm1, %xmm1
	vaddpd	%zmm1, %zmm0, %zmm0
	cmpq	$3, %rdx
	je	.LBB0_32
	cmpq	$-3, %r14
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	24(%rax,%rcx,8), %zmm1
	vminpd	%zmm3, %zmm1, %zmm3
	vmaxpd	%zmm2, %zmm1, %zmm2
	vsubsd	%xmm1, %xmm1, %xmm1
	vaddpd	%zmm1, %zmm0, %zmm0
	cmpq	$4, %rdx
	je	.LBB0_32
	cmpq	$-4, %r14
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	32(%rax,%rcx,8), %zmm1
	vminpd	%zmm3, %zmm1, %zmm3
	vmaxpd	%zmm2, %zmm1, %zmm2
	vsubsd	%xmm1, %xmm1, %xmm1
	vaddpd	%zmm1, %zmm0, %zmm0
	cmpq	$5, %rdx
	je	.LBB0_32
	cmpq	$-5, %r14
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	40(%rax,%rcx,8), %zmm1
	vminpd	%zmm3, %zmm1, %zmm3
	vmaxpd	%zmm2, %zmm1, %zmm2
	vsubsd	%xmm1, %xmm1, %xmm1
	vaddpd	%zmm1, %zmm0, %zmm0
	cmpq	$6, %rdx
	jne	.LBB0_37
.LBB0_32:
	vmovupd	%zmm3, 400(%rsp)
	vmovupd	%zmm2, 464(%rsp)
	vbroadcastsd	%xmm0, %zmm0
.LBB0_38:
	vmovupd	%zmm0, 608(%rsp)
.LBB0_39:
	movq	(%rsp), %rdi
	vzeroupper
	callq	*%rbp
	vmovupd	32(%rsp), %zmm1
	vmovupd	608(%rsp), %zmm5
	xorl	%edi, %edi
	jmp	.LBB0_50
.LBB0_44:
	vbroadcastsd	(%rdx), %zmm2
	vbroadcastsd	(%rcx), %zmm4
	movq	320(%rsp), %rdx
	movq	16(%rsp), %rbx
	vxorpd	%xmm5, %xmm5, %xmm5
	xorl	%ecx, %ecx
	.p2align	4
.LBB0_45:
	cmpq	%rcx, %r12
	movq	%rcx, %r8
	leaq	8(%rcx), %rdi
	leaq	56(%rcx), %rsi
	cmovlq	%r12, %r8
	cmpq	%rdi, %r12
	vmovupd	(%rax,%r8,8), %zmm0
	cmovlq	%r12, %rdi
	leaq	16(%rcx), %r8
	vmovupd	(%rax,%rdi,8), %zmm3
	cmpq	%r8, %r12
	leaq	24(%rcx), %rdi
	cmovlq	%r12, %r8
	cmpq	%rdi, %r12
	cmovlq	%r12, %rdi
	vminpd	%zmm4, %zmm0, %zmm1
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	32(%rcx), %r8
	cmpq	%r8, %r12
	vminpd	%zmm1, %zmm3, %zmm1
	vmaxpd	%zmm2, %zmm3, %zmm2
	vsubpd	%zmm3, %zmm3, %zmm3
	cmovlq	%r12, %r8
	vaddpd	%zmm0, %zmm5, %zmm0
	vmovupd	(%rax,%rdi,8), %zmm5
	leaq	40(%rcx), %rdi
	cmpq	%rdi, %r12
	cmovlq	%r12, %rdi
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	48(%rcx), %r8
	cmpq	%r8, %r12
	cmovlq	%r12, %r8
	cmpq	%rsi, %r12
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rdi,8), %zmm5
	cmovlq	%r12, %rsi
	addq	$64, %rcx
	addq	$-8, %rdx
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rsi,8), %zmm5
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm4, %zmm4, %zmm3
	vmaxpd	%zmm2, %zmm4, %zmm2
	vminpd	%zmm1, %zmm4, %zmm1
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vminpd	%zmm1, %zmm5, %zmm4
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm5
	jne	.LBB0_45
	vmovupd	32(%rsp), %zmm1
	movq	(%rsp), %rdi
	cmpq	$0, 248(%rsp)
	vmovupd	%zmm4, 400(%rsp)
	vmovupd	%zmm2, 464(%rsp)
	je	.LBB0_50
.LBB0_47:
	vmovupd	464(%rsp), %zmm2
	vmovupd	400(%rsp), %zmm3
	movq	248(%rsp), %rdx
	.p2align	4
.LBB0_48:
	cmpq	%rcx, %r12
	leaq	8(%rcx), %rsi
	cmovlq	%r12, %rcx
	decq	%rdx
	vmovupd	(%rax,%rcx,8), %zmm0
	movq	%rsi, %rcx
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vaddpd	%zmm0, %zmm5, %zmm5
	jne	.LBB0_48
	movq	(%rsp), %rdi
	vmovupd	%zmm3, 400(%rsp)
	vmovupd	%zmm2, 464(%rsp)
.LBB0_50:
	vaddpd	%zmm5, %zmm1, %zmm1
	vmovupd	%zmm1, 32(%rsp)
	vzeroupper
	callq	*%rbp
	vmovupd	96(%rsp), %zmm0
	vmovupd	400(%rsp), %zmm1
	vmovupd	160(%rsp), %zmm2
	movq	264(%rsp), %rax
	vminpd	%zmm0, %zmm1, %zmm0
	vmovupd	464(%rsp), %zmm1
	vmovupd	%zmm0, 96(%rsp)
	vmaxpd	%zmm2, %zmm1, %zmm0
	vmovupd	%zmm0, 160(%rsp)
	cmpq	880(%rsp), %rax
	jge	.LBB0_51
	movq	(%rsp), %rdi
	movabsq	$NRT_incref, %rax
	vzeroupper
	callq	*%rax
	movq	904(%rsp), %rdx
	cmpq	$8, %rdx
	jge	.LBB0_64
	vmovupd	32(%rsp), %zmm1
	testq	%rdx, %rdx
	jle	.LBB0_62
	movq	8(%rsp), %rax
	movq	%rbx, %rcx
	sarq	$63, %rcx
	vmovupd	96(%rsp), %zmm3
	vmovupd	160(%rsp), %zmm2
	andq	%r13, %rcx
	leaq	(%rax,%rbx,8), %rax
	vbroadcastsd	(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$1, %rdx
	je	.LBB0_54
	cmpq	$-1, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	8(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$2, %rdx
	je	.LBB0_54
	cmpq	$-2, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	16(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$3, %rdx
	je	.LBB0_54
	cmpq	$-3, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	24(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$4, %rdx
	je	.LBB0_54
	cmpq	$-4, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	32(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$5, %rdx
	je	.LBB0_54
	cmpq	$-5, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	40(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$6, %rdx
	jne	.LBB0_60
.LBB0_54:
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
.LBB0_61:
	vmovupd	%zmm1, 32(%rsp)
.LBB0_62:
	movq	(%rsp), %rdi
	vzeroupper
	callq	*%rbp
	xorl	%edi, %edi
	jmp	.LBB0_7
	.p2align	4
.LBB0_64:
	vmovupd	32(%rsp), %zmm3
	cmpq	$0, 352(%rsp)
	movq	240(%rsp), %r9
	je	.LBB0_6
	movq	8(%rsp), %rax
	cmpq	$64, 336(%rsp)
	leaq	(%rax,%rbx,8), %rax
	jae	.LBB0_67
	xorl	%ecx, %ecx
	jmp	.LBB0_3
.LBB0_67:
	vmovupd	160(%rsp), %zmm2
	vmovupd	96(%rsp), %zmm4
	movq	296(%rsp), %rdx
	xorl	%ecx, %ecx
	.p2align	4
.LBB0_68:
	cmpq	%rcx, %r9
	movq	%rcx, %r8
	leaq	8(%rcx), %rdi
	leaq	56(%rcx), %rsi
	cmovlq	%r9, %r8
	cmpq	%rdi, %r9
	vmovupd	(%rax,%r8,8), %zmm0
	cmovlq	%r9, %rdi
	leaq	16(%rcx), %r8
	vmovupd	(%rax,%rdi,8), %zmm5
	cmpq	%r8, %r9
	leaq	24(%rcx), %rdi
	cmovlq	%r9, %r8
	cmpq	%rdi, %r9
	cmovlq	%r9, %rdi
	vminpd	%zmm4, %zmm0, %zmm1
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	32(%rcx), %r8
	cmpq	%r8, %r9
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	cmovlq	%r9, %r8
	vaddpd	%zmm0, %zmm3, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rdi,8), %zmm5
	leaq	40(%rcx), %rdi
	cmpq	%rdi, %r9
	cmovlq	%r9, %rdi
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	48(%rcx), %r8
	cmpq	%r8, %r9
	cmovlq	%r9, %r8
	cmpq	%rsi, %r9
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rdi,8), %zmm5
	cmovlq	%r9, %rsi
	addq	$64, %rcx
	addq	$-8, %rdx
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rsi,8), %zmm5
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm4, %zmm4, %zmm3
	vmaxpd	%zmm2, %zmm4, %zmm2
	vminpd	%zmm1, %zmm4, %zmm1
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vminpd	%zmm1, %zmm5, %zmm4
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm3
	jne	.LBB0_68
	movq	(%rsp), %rdi
	cmpq	$0, 232(%rsp)
	vmovupd	%zmm4, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vmovupd	%zmm3, 32(%rsp)
	je	.LBB0_7
.LBB0_3:
	vmovupd	32(%rsp), %zmm1
	vmovupd	160(%rsp), %zmm2
	vmovupd	96(%rsp), %zmm3
	movq	232(%rsp), %rdx
	movq	240(%rsp), %rdi
	.p2align	4
.LBB0_4:
	cmpq	%rcx, %rdi
	leaq	8(%rcx), %rsi
	cmovlq	%rdi, %rcx
	decq	%rdx
	vmovupd	(%rax,%rcx,8), %zmm0
	movq	%rsi, %rcx
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	jne	.LBB0_4
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vmovupd	%zmm1, 32(%rsp)
.LBB0_6:
	movq	(%rsp), %rdi
.LBB0_7:
	addq	912(%rsp), %rbx
	vzeroupper
	callq	*%rbp
	movq	24(%rsp), %rdi
	callq	*%rbp
	movq	368(%rsp), %rdx
	cmpq	$8, %rdx
	jge	.LBB0_77
	vmovupd	32(%rsp), %zmm1
	vmovupd	160(%rsp), %zmm2
	vmovupd	96(%rsp), %zmm3
	testq	%rdx, %rdx
	jle	.LBB0_76
	movq	8(%rsp), %rax
	movq	%rbx, %rcx
	sarq	$63, %rcx
	andq	%r13, %rcx
	leaq	(%rax,%rbx,8), %rax
	vbroadcastsd	(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$1, %rdx
	je	.LBB0_10
	cmpq	$-1, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	8(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$2, %rdx
	je	.LBB0_10
	cmpq	$-2, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	16(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$3, %rdx
	je	.LBB0_10
	cmpq	$-3, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	24(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$4, %rdx
	je	.LBB0_10
	cmpq	$-4, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	32(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$5, %rdx
	je	.LBB0_10
	cmpq	$-5, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	40(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	cmpq	$6, %rdx
	jne	.LBB0_74
.LBB0_10:
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
.LBB0_75:
	vmovupd	%zmm1, 32(%rsp)
.LBB0_76:
	movq	(%rsp), %rdi
	vzeroupper
	callq	*%rbp
	xorl	%edi, %edi
	jmp	.LBB0_16
	.p2align	4
.LBB0_77:
	vmovupd	32(%rsp), %zmm3
	vmovupd	160(%rsp), %zmm2
	vmovupd	96(%rsp), %zmm4
	cmpq	$0, 344(%rsp)
	je	.LBB0_15
	movq	8(%rsp), %rax
	cmpq	$64, 328(%rsp)
	leaq	(%rax,%rbx,8), %rax
	jae	.LBB0_80
	xorl	%ecx, %ecx
	jmp	.LBB0_12
.LBB0_80:
	movq	288(%rsp), %rdx
	xorl	%ecx, %ecx
	.p2align	4
.LBB0_81:
	cmpq	%rcx, %r15
	movq	%rcx, %r8
	leaq	8(%rcx), %rdi
	leaq	56(%rcx), %rsi
	cmovlq	%r15, %r8
	cmpq	%rdi, %r15
	vmovupd	(%rax,%r8,8), %zmm0
	cmovlq	%r15, %rdi
	leaq	16(%rcx), %r8
	vmovupd	(%rax,%rdi,8), %zmm5
	cmpq	%r8, %r15
	leaq	24(%rcx), %rdi
	cmovlq	%r15, %r8
	cmpq	%rdi, %r15
	cmovlq	%r15, %rdi
	vminpd	%zmm4, %zmm0, %zmm1
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	32(%rcx), %r8
	cmpq	%r8, %r15
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	cmovlq	%r15, %r8
	vaddpd	%zmm0, %zmm3, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rdi,8), %zmm5
	leaq	40(%rcx), %rdi
	cmpq	%rdi, %r15
	cmovlq	%r15, %rdi
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	leaq	48(%rcx), %r8
	cmpq	%r8, %r15
	cmovlq	%r15, %r8
	cmpq	%rsi, %r15
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rdi,8), %zmm5
	cmovlq	%r15, %rsi
	addq	$64, %rcx
	addq	$-8, %rdx
	vaddpd	%zmm3, %zmm0, %zmm0
	vminpd	%zmm1, %zmm4, %zmm1
	vmaxpd	%zmm2, %zmm4, %zmm2
	vsubpd	%zmm4, %zmm4, %zmm3
	vmovupd	(%rax,%r8,8), %zmm4
	vminpd	%zmm1, %zmm5, %zmm1
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vmovupd	(%rax,%rsi,8), %zmm5
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm4, %zmm4, %zmm3
	vmaxpd	%zmm2, %zmm4, %zmm2
	vminpd	%zmm1, %zmm4, %zmm1
	vaddpd	%zmm3, %zmm0, %zmm0
	vsubpd	%zmm5, %zmm5, %zmm3
	vminpd	%zmm1, %zmm5, %zmm4
	vmaxpd	%zmm2, %zmm5, %zmm2
	vaddpd	%zmm3, %zmm0, %zmm3
	jne	.LBB0_81
	movq	(%rsp), %rdi
	cmpq	$0, 224(%rsp)
	vmovupd	%zmm4, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vmovupd	%zmm3, 32(%rsp)
	je	.LBB0_16
.LBB0_12:
	vmovupd	32(%rsp), %zmm1
	vmovupd	160(%rsp), %zmm2
	vmovupd	96(%rsp), %zmm3
	movq	224(%rsp), %rdx
	.p2align	4
.LBB0_13:
	cmpq	%rcx, %r15
	leaq	8(%rcx), %rsi
	cmovlq	%r15, %rcx
	decq	%rdx
	vmovupd	(%rax,%rcx,8), %zmm0
	movq	%rsi, %rcx
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubpd	%zmm0, %zmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	jne	.LBB0_13
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vmovupd	%zmm1, 32(%rsp)
.LBB0_15:
	movq	(%rsp), %rdi
.LBB0_16:
	vzeroupper
	callq	*%rbp
	xorl	%edi, %edi
	xorl	%ebx, %ebx
	jmp	.LBB0_17
.LBB0_37:
	cmpq	$-6, %r14
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	48(%rax,%rcx,8), %zmm1
	vminpd	%zmm3, %zmm1, %zmm3
	vmaxpd	%zmm2, %zmm1, %zmm2
	vsubsd	%xmm1, %xmm1, %xmm1
	vmovupd	%zmm3, 400(%rsp)
	vmovupd	%zmm2, 464(%rsp)
	vaddsd	%xmm1, %xmm0, %xmm0
	vbroadcastsd	%xmm0, %zmm0
	jmp	.LBB0_38
.LBB0_60:
	cmpq	$-6, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	48(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	jmp	.LBB0_61
.LBB0_74:
	cmpq	$-6, %rbx
	movl	$0, %ecx
	cmovlq	%r13, %rcx
	vbroadcastsd	48(%rax,%rcx,8), %zmm0
	vminpd	%zmm3, %zmm0, %zmm3
	vmaxpd	%zmm2, %zmm0, %zmm2
	vsubsd	%xmm0, %xmm0, %xmm0
	vmovupd	%zmm3, 96(%rsp)
	vmovupd	%zmm2, 160(%rsp)
	vbroadcastsd	%xmm0, %zmm0
	vaddpd	%zmm0, %zmm1, %zmm1
	jmp	.LBB0_75
.LBB0_1:
	movq	(%rsp), %rcx
	movabsq	$.const.picklebuf.dc3bba832c4c3758273d0db24b835691af3f316c, %rax
	movq	%rax, (%rcx)
	movl	$1, %eax
	jmp	.LBB0_22
.LBB0_24:
	vbroadcastsd	(%rcx), %zmm0
	vmovups	%zmm0, 96(%rsp)
	vbroadcastsd	(%rdx), %zmm0
	vmovupd	%zmm0, 160(%rsp)
	vxorpd	%xmm0, %xmm0, %xmm0
	vmovupd	%zmm0, 32(%rsp)
.LBB0_18:
	vmovupd	96(%rsp), %zmm1
	movq	976(%rsp), %rdi
	vextractf64x4	$1, %zmm1, %ymm0
	vminpd	%ymm1, %ymm0, %ymm0
	vextractf128	$1, %ymm0, %xmm1
	vminpd	%xmm0, %xmm1, %xmm0
	vshufpd	$1, %xmm0, %xmm0, %xmm1
	vminsd	%xmm0, %xmm1, %xmm0
	vmovsd	%xmm0, 96(%rsp)
	vzeroupper
	callq	*%rbp
	movq	920(%rsp), %rdi
	callq	*%rbp
	movq	(%rsp), %rdi
	callq	*%rbp
	vmovsd	96(%rsp), %xmm0
	movq	312(%rsp), %rbx
	vucomisd	304(%rsp), %xmm0
	jae	.LBB0_82
	movq	24(%rsp), %rdi
	callq	*%rbp
	jmp	.LBB0_20
.LBB0_82:
	vmovupd	160(%rsp), %zmm1
	movq	24(%rsp), %rdi
	vextractf64x4	$1, %zmm1, %ymm0
	vmaxpd	%ymm1, %ymm0, %ymm0
	vextractf128	$1, %ymm0, %xmm1
	vmaxpd	%xmm0, %xmm1, %xmm0
	vshufpd	$1, %xmm0, %xmm0, %xmm1
	vmaxsd	%xmm0, %xmm1, %xmm0
	vmovsd	%xmm0, (%rsp)
	vzeroupper
	callq	*%rbp
	vmovsd	280(%rsp), %xmm0
	vucomisd	(%rsp), %xmm0
	jae	.LBB0_83
.LBB0_20:
	xorl	%eax, %eax
	jmp	.LBB0_21
.LBB0_83:
	vmovupd	32(%rsp), %zmm1
	vextractf64x4	$1, %zmm1, %ymm0
	vaddpd	%ymm0, %ymm1, %ymm0
	vextractf128	$1, %ymm0, %xmm1
	vaddpd	%xmm1, %xmm0, %xmm0
	vshufpd	$1, %xmm0, %xmm0, %xmm1
	vaddsd	%xmm1, %xmm0, %xmm0
	vxorpd	%xmm1, %xmm1, %xmm1
	vcmpeqsd	%xmm1, %xmm0, %k0
	kmovd	%k0, %eax
.LBB0_21:
	movb	%al, (%rbx)
	xorl	%eax, %eax
.LBB0_22:
	addq	$808, %rsp
	popq	%rbx
	popq	%r12
	popq	%r13
	popq	%r14
	popq	%r15
	popq	%rbp
	vzeroupper
	retq